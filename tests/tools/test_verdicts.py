"""Unusual clips that are right are not called wrong, and broken ones get the fix that undoes it.

Two of the clips of ``tools/verdicts``, smaller; its page has all of them. The oracle is the corruption itself.
"""

import pytest

from essjax.data import read_dataset
from tests.data.check.corrupt import SIZE
from tools.verdicts.__main__ import RIGHT, SILENT, outcome, page, wrongs
from tools.verdicts.clips import CLIPS, render
from tools.verdicts.corruptions import CORRUPTIONS


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Of the size of the other tests of the check, whose programs they share."""
    root = tmp_path_factory.mktemp("clips")
    names = ("ropes over a mirror", "fast spin")
    return {name: render(name, root / name, width=SIZE[0], height=SIZE[1], spp=9) for name in names}


def test_unusual_clips_are_right(clips):
    """Ropes before a plain sky over a mirror: most that moves in the picture is not the surface."""
    assert {name: wrongs(dataset) for name, dataset in clips.items()} == dict.fromkeys(clips, [])


@pytest.mark.parametrize(
    ("clip", "name"),
    [
        ("ropes over a mirror", "times 1/2"),
        ("ropes over a mirror", "depth reversed"),
        ("fast spin", "NDC"),
        ("fast spin", "one object still"),
        ("fast spin", "sky still"),
        ("fast spin", "jitter halved"),
        ("fast spin", "jitter absent"),
        ("fast spin", "normals signed, read as unsigned"),
        ("fast spin", "normals unsigned, read as signed"),
    ],
)
def test_a_broken_clip_gets_its_fix_and_no_other(clips, tmp_path, clip, name):
    verdict, found = outcome(read_dataset(clips[clip].path), CORRUPTIONS[name], tmp_path)
    assert verdict == RIGHT, found


def test_the_page_counts():
    table = {(clip, name): RIGHT for clip in CLIPS for name in CORRUPTIONS}
    first = next(iter(table))
    table[first] = SILENT
    text = page(list(CLIPS), list(CORRUPTIONS), table, dict.fromkeys(CLIPS, []), [])
    count = len(CLIPS) * len(CORRUPTIONS) - 1
    assert f"**{count} of {count}** (100.0%)" in text and "**0**" in text
