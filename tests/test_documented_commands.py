"""Every shell command in README, CONTRIBUTING, the guides and tools: its parser takes it, and what it names exists.

What is cheap is really run, at a small size; the run command end to end: ``tests/experiments/test_run.py``.
"""

import ast
import functools
import importlib.util
import inspect
import re
import runpy
import shlex
import sys
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import tyro

from essjax import cli
from essjax.builtin import plan
from essjax.data.importing import PRESETS
from essjax.data.importing.recipe import load_recipe
from experiments import compare, run, tables
from experiments.benchmark import __main__ as benchmark
from experiments.members import all_settings
from experiments.tables import __main__ as tables_command
from tests.test_cli import instant_renderer  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs/guides").glob("*.md"))]
PAGES += sorted((ROOT / "tools").glob("*/README.md"))
INLINE = r"(\w+=\S+ )?(essjax \w+ \S|python -m|pip install)"
"""How a command in running text begins; `essjax check` alone is the command's name."""


def commands():
    """``(page, words)`` of each command in shell blocks, and of those in the text that have arguments."""
    for page in PAGES:
        text = page.read_text()
        lines = [line for block in re.findall(r"^```bash\n(.*?)^```", text, re.M | re.S) for line in block.splitlines()]
        prose = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
        lines += [span for span in re.findall(r"`([^`\n]+)`", prose) if re.match(INLINE, span)]
        for line in lines:
            words = shlex.split(line, comments=True)
            while words:
                cut = words.index("&&") if "&&" in words else len(words)
                one, words = words[:cut], words[cut + 1 :]
                yield page.name, [word for word in one if not re.fullmatch(r"[A-Z_]+=\S*", word)]


ALL = list(dict.fromkeys((page, tuple(words)) for page, words in commands()))


def check_pip(arguments):
    with open(ROOT / "pyproject.toml", "rb") as file:
        extras = tomllib.load(file)["project"]["optional-dependencies"]
    for argument in arguments:
        for extra in re.findall(r"\.\[(.*)\]", argument):
            assert set(extra.split(",")) <= set(extras), f"no extra {extra}"


def check_pytest(arguments):
    places = [word for word in arguments if not word.startswith("-") and "/" in word]
    assert all((ROOT / place).exists() for place in places), places


def parsed_by_essjax(arguments):
    """The command's name and its arguments, as its function would get them."""
    seen = {}

    def recorded(name, function):
        @functools.wraps(function)
        def record(*positional, **options):
            seen.update(command=name, positional=positional, **options)

        return record

    functions = {name: recorded(name, function) for name, function in cli.COMMANDS.items()}
    tyro.extras.subcommand_cli_from_dict(functions, prog="essjax", args=list(arguments))
    return seen


def check_essjax(arguments):
    options = parsed_by_essjax([word.replace("NAME", "unreal") for word in arguments])
    if options["command"] == "scenes":
        cli.parse_size(options["size"])
        families = options["families"].split(",") if options["families"] else None
        assert plan(options["split"], options["sequences"], options["frames"], families=families)
    if options["command"] == "import":
        assert options["preset"] in PRESETS
        assert (options["preset"] == "generic") == (options["recipe"] is not None)
        assert all(
            cli.parse_split(options[split], split) for split in ("train", "validation", "test") if options[split]
        )


def check_run(arguments):
    options = run.parse(arguments)
    all_settings([options.variant], options.preset, options.overrides)


def check_compare(arguments):
    options = compare.parse(arguments)
    assert all_settings(options.variants.split(","), options.preset, options.overrides)


def check_tables(arguments):
    options = tables_command.parse(arguments)
    assert all(tables.get_table(name) for name in options.names)
    assert all_settings(["extrass"], options.preset, options.overrides)


def check_benchmark(arguments):
    options = benchmark.parse(arguments)
    assert set(options.suite) <= set(benchmark.SUITES) and benchmark._size(options.size)
    assert set(options.dtypes) <= {"float32", "bfloat16", "float16"}


MODULES = {
    "pytest": check_pytest, "experiments.run": check_run, "experiments.compare": check_compare,
    "experiments.tables": check_tables, "experiments.benchmark": check_benchmark,
}  # fmt: skip


def check_blender(arguments, monkeypatch):
    stub = ModuleType("bpy")
    stub.app = SimpleNamespace(binary_path="")
    monkeypatch.setitem(sys.modules, "bpy", stub)
    monkeypatch.syspath_prepend(str(ROOT / "tools/blender"))
    script = runpy.run_path(str(ROOT / "tools/blender/render_essjax.py"))
    monkeypatch.setattr(sys, "argv", ["render_essjax.py", *arguments])
    assert script["parse_args"]().out == Path("clip")


@pytest.mark.parametrize(("page", "words"), ALL, ids=[f"{page}: {' '.join(words)}" for page, words in ALL])
def test_a_documented_command_is_one(page, words, monkeypatch):
    program, *arguments = words
    script = next((word for word in words if re.match(r"tools/.*\.py", word)), None)
    if script is not None:
        assert (ROOT / script).is_file()
        rest = arguments[arguments.index("--" if "--" in arguments else script) + 1 :]
        check_blender(rest, monkeypatch)
    elif program.endswith("pip"):
        check_pip(arguments)
    elif program == "essjax":
        check_essjax(arguments)
    elif program == "python" and arguments[0] == "-m":
        module = arguments[1]
        assert importlib.util.find_spec(module), f"no module {module}"
        MODULES.get(module, lambda arguments: None)(arguments[2:])
    else:
        known = ("ruff", "pyright", "pre-commit", "python3.11")
        assert program in known, f"{page}: a command of a kind that this test does not know: {' '.join(words)}"


def test_the_commands_are_found():
    texts = [" ".join(words) for _, words in ALL]
    assert len(texts) > 35
    for expected in (
        "python -m experiments.run --variant extrass", "essjax check mydata --json check.json --pictures warps",
        "python -m pytest tests/experiments/test_every_variant.py --dist load",
        "essjax scenes OUT --split test --sequences 2 --frames 32 --size 128x72 --scale 2",
    ):  # fmt: skip
        assert expected in texts, expected


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("python", "-m", "experiments.run", "--variant", "extras"), "unknown variant 'extras'"),
        (("python", "-m", "experiments.run", "--set", "widht=24"), "unknown setting 'widht'"),
        (("essjax", "scenes", "OUT", "--families", "forest"), "got 'forest'"),
        (("pip", "install", "-e", ".[bench,torch]"), "no extra"),
        (("python", "-m", "experiments.score"), "no module"),
        (("esjax", "check", "mydata"), "does not know"),
    ],
)
def test_a_wrong_command_is_found(words, message, monkeypatch):
    with pytest.raises((ValueError, AssertionError), match=message):
        test_a_documented_command_is_one("page", words, monkeypatch)


def test_recipes_of_the_guide_are_read(tmp_path):
    text = (ROOT / "docs/guides/importing.md").read_text()
    blocks = re.findall(r"^```toml\n(.*?)^```", text, re.M | re.S)
    whole = [block for block in blocks if "[files]" in block]
    assert len(whole) == 2 and len(blocks) > 3
    for block in blocks:
        path = tmp_path / "recipe.toml"
        path.write_text(block)
        load_recipe("generic" if block in whole else "unreal", path)


def test_calls_of_the_readme_fit_their_functions():
    """What its Python calls exists and takes these arguments; nothing is run: it would compile for half a minute."""
    (block,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    tree, found = ast.parse(block), []
    imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    scope = {}
    exec(compile(ast.Module(imports, []), "", "exec"), scope)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        module, _, name = ast.unparse(node.func).rpartition(".")
        if module.split(".")[0] in scope:
            function = getattr(eval(module, scope), name)
            inspect.signature(function).bind(*node.args, **{word.arg: word.value for word in node.keywords})
            found.append(name)
    assert {"make_scene", "render_sequence", "backward_warp", "extrass", "unroll"} <= set(found)


def test_the_cheap_ones_run(tmp_path, monkeypatch, capsys, instant_renderer):  # noqa: F811
    """The listings, and the commands on scenes (of noise) and their check at a small size: later options win."""
    assert run.main(["--list"]) == compare.main(["--list"]) == tables_command.main(["--list"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in ("extrass", "dlctus-10"))
    scenes = next(words for _, words in ALL if words[:3] == ("essjax", "scenes", "OUT"))
    check = next(words for _, words in ALL if words[:3] == ("essjax", "check", "mydata") and "--json" in words)
    small = ["--sequences", "1", "--frames", "3", "--size", "32x18", "--spp", "4", "--families", "carousel"]
    monkeypatch.chdir(tmp_path)
    assert cli.main([*scenes[1:], *small]) == 0
    (tmp_path / "OUT").rename(tmp_path / "mydata")
    assert cli.main(list(check[1:])) == 1  # noise does not move as stated
    assert (tmp_path / "check.json").is_file()
