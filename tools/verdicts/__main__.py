"""``python -m tools.verdicts``: what ``essjax check`` says of unusual clips, right and broken, as a Markdown table."""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from essjax.data import Dataset, read_dataset, read_sequence, write_dataset, write_sequence
from essjax.data.check import check_dataset
from essjax.data.check.finding import Finding
from tools.verdicts.clips import CLIPS, UNSEEN, render
from tools.verdicts.corruptions import CORRUPTIONS, Corruption

RIGHT, SILENT, MISSED, MISLED = "named", "not decidable", "missed", "misled"
"""Outcomes: the right fix alone; nothing to see, and nothing said; nothing said; another fix, too."""
PAGE = Path(__file__).parent / "RESULTS.md"
HEAD = """# What `essjax check` says of clips, right and broken

Made by `python -m tools.verdicts`; the clips are in `clips.py`, the corruptions in `corruptions.py`.
*named*: the right fix was told, and no other; *not decidable*: the corruption changes nothing that pictures
could show, and nothing is called wrong; *missed*: nothing is called wrong; *misled*: something else is.
"""


def wrongs(dataset: Dataset) -> list[Finding]:
    """List the findings that say "wrong"."""
    return [finding for finding in check_dataset(dataset, pairs=0).findings if finding.verdict == "wrong"]


def outcome(dataset: Dataset, corruption: Corruption, folder: Path) -> tuple[str, list[Finding]]:
    """Break a clip, check it, and compare what is said with what had to be."""
    good = read_sequence(dataset, "clip")
    broken = corruption.apply(good)
    write_sequence(folder, "clip", broken)
    found = wrongs(write_dataset(folder, {"test": ["clip"]}))
    if not corruption.visible(good, broken):
        return (MISLED if found else SILENT), found
    right = [finding for finding in found if any(fix in finding.fix for fix in corruption.fixes)]
    if not right:
        return (MISLED if found else MISSED), found
    return (RIGHT if len(right) == len(found) else MISLED), found


def examine(clips: Sequence[str], corruptions: Sequence[str], root: Path, temporary: Path) -> str:
    """Render clips that are not there, check them as they are and broken, and write it down as Markdown."""
    table, alarms, details = {}, {}, []
    for clip in clips:
        folder = root / clip.replace(" ", "-")
        dataset = read_dataset(folder) if (folder / "dataset.json").exists() else render(clip, folder)
        alarms[clip] = wrongs(dataset)
        details += [f"- {clip}, as it is: {f.check}: {f.found}. {f.fix}" for f in alarms[clip]]
        for name in corruptions:
            broken = temporary / f"{clip}-{name}".replace("/", "-")
            verdict, found = outcome(dataset, CORRUPTIONS[name], broken)
            table[clip, name] = verdict
            print(f"{clip}, {name}: {verdict}", flush=True)
            if verdict in (MISSED, MISLED):
                details += [f"- {clip}, {name}: {verdict}: {f.check}: {f.found}. {f.fix}" for f in found]
                details += [] if found else [f"- {clip}, {name}: {verdict}"]
    return page(clips, corruptions, table, alarms, details)


def main() -> None:
    """Examine the unusual clips and, apart, those that no constant was chosen on; write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=Path, help="folder to keep the rendered clips in")
    parser.add_argument("--only", choices=("unusual", "unseen"), help="one of the two tables, printed alone")
    arguments = parser.parse_args()
    parts = {"unusual": (CLIPS, "## Unusual clips"), "unseen": (UNSEEN, "## Clips that no constant was chosen on")}
    text = [HEAD]
    with tempfile.TemporaryDirectory() as temporary:
        for name, (clips, title) in parts.items():
            if arguments.only in (None, name):
                root = arguments.clips or Path(temporary) / "clips"
                text += [title, "", examine(list(clips), list(CORRUPTIONS), root, Path(temporary))]
    print("\n".join(text))
    if arguments.only is None:
        PAGE.write_text("\n".join(text), encoding="utf-8")


def page(clips, corruptions, table, alarms, details) -> str:
    """Write the results as Markdown."""
    visible = [v for v in table.values() if v != SILENT]
    named = visible.count(RIGHT)
    lines = [
        f"False alarms on the {len(clips)} clips as they are: **{sum(map(bool, alarms.values()))}**.",
        f"Named with the right fix: **{named} of {len(visible)}** ({named / max(len(visible), 1):.1%});",
        f"misled: {visible.count(MISLED)}, missed: {visible.count(MISSED)}.",
        "",
        "| corruption | " + " | ".join(clips) + " |",
        "|---|" + "---|" * len(clips),
        "| none | " + " | ".join("**wrong**" if alarms[clip] else "ok" for clip in clips) + " |",
        *[f"| {name} | " + " | ".join(table[clip, name] for clip in clips) + " |" for name in corruptions],
        "",
        *(["What was not as it should be:", "", *details, ""] if details else []),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
