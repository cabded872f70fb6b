"""The order of dependencies and the size of files, read from the source (docs/adr/0007)."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LEVELS = {
    "essjax.typing": 0, "essjax.buffers": 0, "essjax.files": 0, "essjax.stopping": 0,
    "essjax.cameras": 1, "essjax.kernels": 1, "essjax.color": 1, "essjax.tensors": 1, "essjax.sizes": 1,
    "essjax.frames": 2,
    "essjax.interfaces": 3, "essjax.warp": 3,
    "essjax.exposure": 4, "essjax.losses": 4, "essjax.networks": 4, "essjax.labels": 4,
    "essjax.methods": 5, "essjax.data": 5, "essjax.scenes": 5,
    "essjax.rollout": 6, "essjax.metrics": 6,
    "essjax.train": 7, "essjax.deploy": 7,
    "essjax.builtin": 8, "essjax.cli": 8, "essjax": 8,
    "experiments": 9,
}  # fmt: skip
"""A module imports only lower levels, its own package aside. Modules of one level do not know each other."""
SAME_LEVEL = {("essjax.cli", "essjax.builtin")}
"""The one exception: the command line offers what builtin joins from scenes and data."""
TEXT_SUFFIXES = {".py", ".md", ".toml", ".cff", ".yaml", ".yml", ".html", ".js", ".css", ".json", ".txt", ".cfg"}
MAX_LINES = 400


def unit_of(module: str) -> str:
    """The entry of LEVELS that a dotted module name belongs to."""
    parts = module.split(".")
    return parts[0] if parts[0] == "experiments" else ".".join(parts[:2])


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def sources() -> list[Path]:
    return sorted([*(ROOT / "essjax").rglob("*.py"), *(ROOT / "experiments").rglob("*.py")])


def project_files() -> list[Path]:
    folders = [ROOT / name for name in ("essjax", "experiments", "tests", "tools", "docs", ".ci", ".github")]
    nested = [path for folder in folders if folder.exists() for path in folder.rglob("*")]
    files = [path for path in [*ROOT.iterdir(), *nested] if path.is_file() and "__pycache__" not in path.parts]
    return sorted(path for path in files if path.suffix in TEXT_SUFFIXES or path.parent.name == ".ci")


def imports(source: str, module: str, *, is_package: bool = False) -> set[str]:
    """Dotted names of every module that ``source`` imports, wherever in the file; relative ones are resolved."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".") if is_package else module.split(".")[:-1]
                base = ".".join([*package[: len(package) - node.level + 1], *([base] if base else [])])
            if base in ("essjax", "experiments"):  # from essjax import warp
                found |= {f"{base}.{alias.name}" for alias in node.names}
            else:
                found.add(base)
    return found


def violations(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """What ``module`` imports and must not."""
    unit, wrong = unit_of(module), []
    for name in sorted(imports(source, module, is_package=is_package)):
        top = name.split(".")[0]
        if top == "flax" and unit != "essjax.networks":
            wrong.append(f"{module} imports {name}: only essjax.networks may import flax")
        if top not in ("essjax", "experiments"):
            continue
        other = unit_of(name)
        if other not in LEVELS:
            other = "essjax"  # a plain name such as __version__
        if other in (unit, "essjax") or (unit, other) in SAME_LEVEL:
            continue
        if LEVELS[other] >= LEVELS[unit]:
            wrong.append(f"{module} (level {LEVELS[unit]}) imports {name} (level {LEVELS[other]})")
    return wrong


@pytest.mark.parametrize("path", sources(), ids=module_name)
def test_imports_only_lower_levels(path):
    module = module_name(path)
    assert unit_of(module) in LEVELS, f"{module}: give it a level in tests/test_architecture.py and docs/adr/0007"
    assert not violations(path.read_text(), module, is_package=path.name == "__init__.py")


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        ("essjax.warp.backward", "from essjax.methods import taau", "essjax.methods"),
        ("essjax.losses.pixel", "import essjax.networks._frnet", "essjax.networks"),
        ("essjax.networks._frnet", "from essjax import losses", "essjax.losses"),
        ("essjax.scenes.render", "def f():\n    from essjax.data.exr import read", "essjax.data"),
        ("essjax.data.loader", "from ..scenes import render", "essjax.scenes"),
        ("essjax.methods._extrass", "from flax import linen", "only essjax.networks"),
        ("essjax.train.step", "from experiments.variants import VARIANTS", "experiments"),
    ],
)
def test_the_check_sees_what_is_forbidden(module, source, expected):
    assert any(expected in message for message in violations(source, module))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("essjax.networks._frnet", "import flax.linen as nn\nfrom essjax.interfaces import Network"),
        ("essjax.methods._extrass", "from essjax.networks import frnet\nfrom essjax.methods.baselines import jau"),
        ("essjax.warp", "from .sampling import sample"),
        ("experiments.run", "from essjax.cli import main\nfrom essjax import __version__"),
    ],
)
def test_the_check_allows_what_is_allowed(module, source):
    assert not violations(source, module, is_package=module == "essjax.warp")


@pytest.mark.parametrize("path", [p for p in project_files() if p.suffix == ".py"], ids=lambda p: str(p.name))
def test_files_are_short(path):
    lines = len(path.read_text().splitlines())
    assert lines <= MAX_LINES, f"{path.relative_to(ROOT)}: {lines} lines; split it by what a reader would look for"


def test_no_postponed_annotations():
    offenders = [str(p) for p in sources() if "from __future__ import " + "annotations" in p.read_text()]
    assert not offenders, "postponed annotations switch jaxtyping's checks off"


def test_no_absolute_paths_of_a_machine():
    pattern = re.compile(r"(?<![\w.~-])/(?:" + "|".join(["work", "home", "Users", "root"]) + r")/\w")
    offenders = [
        f"{path.relative_to(ROOT)}: {line.strip()[:80]}"
        for path in project_files()
        for line in path.read_text(errors="replace").splitlines()
        if pattern.search(line)
    ]
    assert not offenders


def test_ci_runs_the_test_command_of_the_readme():
    command = "pip install -e '.[test]' && python -m pytest"
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()
    assert command in (ROOT / "README.md").read_text()
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111


def circles(edges: dict[str, set[str]]) -> list[str]:
    """Modules that import themselves by way of others."""
    found = []
    for module in edges:
        reached, new = set(), edges[module]
        while new:
            reached |= new
            new = {name for each in new for name in edges.get(each, ())} - reached
        if module in reached:
            found.append(module)
    return sorted(found)


def test_modules_of_essjax_do_not_import_each_other_in_circles():
    """Also not inside functions, where Triton kernels are imported."""
    modules = {module_name(path): path for path in sources() if path.is_relative_to(ROOT / "essjax")}
    edges: dict[str, set[str]] = {module: set() for module in modules}
    for module, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                for name in (f"{node.module}.{alias.name}" for alias in node.names):
                    edges[module].add(name if name in modules else str(node.module))
            elif isinstance(node, ast.Import):
                edges[module] |= {alias.name for alias in node.names}
    assert not circles(edges)
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
