"""The public surface: lazy, named once, nothing that is there by accident, and as ``api.txt`` records it.

``python -m tests.test_api`` writes ``api.txt`` again, after a change that is meant.
"""

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
import tomllib

import essjax
from tests.test_architecture import ROOT, module_name, sources


def test_import_essjax_leaves_jax_out_and_modules_come_when_named():
    program = (
        "import sys, essjax; assert not {'jax', 'numpy', 'flax'} & set(sys.modules);"
        "assert callable(essjax.methods.extrass); assert 'jax' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_dir_and_wrong_names():
    assert set(essjax.__all__) < set(dir(essjax))
    try:
        essjax.method  # noqa: B018
    except AttributeError as error:
        assert str(error) == "module 'essjax' has no attribute 'method'"


def test_every_module_is_offered():
    found = {module.name for module in pkgutil.iter_modules(essjax.__path__) if not module.name.startswith("_")}
    assert found - {"cli"} == set(essjax.__all__)


def defined(tree: ast.Module) -> set[str]:
    """Names that a module defines itself, and what it lists in ``__all__``."""
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found = {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
            names |= found | (set(ast.literal_eval(node.value)) if "__all__" in found else set())
    return names


TREES = {
    module_name(path): ast.parse(path.read_text()) for path in [*sources(), *sorted((ROOT / "tests").rglob("*.py"))]
}
NAMES = {module: defined(tree) for module, tree in TREES.items()}


def accidents(tree: ast.Module) -> list[str]:
    """What a module takes from another that only imported it: ``rollout.select_time``."""
    found, modules = [], {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in NAMES:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                if name in NAMES:
                    modules[alias.asname or alias.name] = name
                elif alias.name not in NAMES[node.module]:
                    found.append(name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            name = f"{modules[node.value.id]}.{node.attr}"
            if name not in NAMES and node.attr not in NAMES[modules[node.value.id]]:
                found.append(name)
    return found


def test_names_are_taken_from_where_they_are_made():
    ours = {module: accidents(tree) for module, tree in TREES.items() if not module.startswith("tests.")}
    assert not {module: names for module, names in ours.items() if names}
    assert accidents(ast.parse("from essjax import rollout\nrollout.select_time")) == ["essjax.rollout.select_time"]
    assert accidents(ast.parse("from essjax.rollout import select_time")) == ["essjax.rollout.select_time"]


def test_no_module_has_the_name_of_what_it_holds():
    """``essjax.warp.splat`` would be the function or the module, by the order of imports."""
    offenders = [
        module
        for module, tree in TREES.items()
        for node in tree.body
        if module.startswith("essjax.") and getattr(node, "name", "") == module.rpartition(".")[2]
    ]
    assert not offenders, "put an underscore in front of the module's name"


def public():
    """Dotted name -> what ``essjax`` offers under it: of a package its ``__all__``, of a module what it defines."""
    for name in essjax.__all__:
        module = importlib.import_module(f"essjax.{name}")
        for member in getattr(module, "__all__", sorted(NAMES[module.__name__])):
            if not member.startswith("_"):
                yield f"{name}.{member}", getattr(module, member)


DATA = {
    "cameras.pixel_positions": {"jitter"}, "color.demodulation_albedo": {"metallic", "specular"},
    "data.read_sequence": {"frames"}, "exposure.exposed": {"map_radiance"}, "frames.check_dtypes": {"where"},
    "frames.check_shapes": {"where"}, "frames.validate_frame": {"where", "requires"},
    "frames.validate_ranges": {"where"}, "frames.validate_sequence": {"name", "requires"},
    "rollout.alternate": {"phase"},
    "tensors.read_tensors": {"what"}, "train.predict_last": {"schedule"},
}  # fmt: skip
"""Arguments with a default that may be given by position: what a function works on, not how."""


def test_tunables_are_keyword_only():
    found = {
        name: {
            parameter.name
            for parameter in inspect.signature(value).parameters.values()
            if parameter.kind is parameter.POSITIONAL_OR_KEYWORD and parameter.default is not parameter.empty
        }
        for name, value in public()
        if inspect.isfunction(value)
    }
    assert {name: arguments for name, arguments in found.items() if arguments} == DATA


def test_the_wheel_holds_essjax_alone():
    """``experiments`` run from the clone; ``pip install`` puts one name into site-packages."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        setuptools = tomllib.load(file)["tool"]["setuptools"]
    assert setuptools["packages"]["find"] == {"include": ["essjax*"]}
    assert all(package.startswith("essjax.") for package in setuptools["package-data"])


RECORD = ROOT / "tests" / "api.txt"


def surface() -> str:
    """One line per public name: a function with its arguments, a class with its fields, a method of a class too."""
    return "".join(sorted(f"{name}{_arguments(value)}\n" for name, value in public()))


def _arguments(value) -> str:
    fields = getattr(value, "__dataclass_fields__", None) or getattr(value, "_fields", None)
    if fields:
        return f"({', '.join(fields)})"
    if not inspect.isfunction(getattr(value, "__wrapped__", value)):
        return ""
    parameters = inspect.signature(value).parameters.values()
    bare = [parameter.replace(default=parameter.empty, annotation=parameter.empty) for parameter in parameters]
    return str(inspect.Signature(bare))


def test_the_surface_is_as_recorded():
    recorded, now = set(RECORD.read_text().splitlines()), set(surface().splitlines())
    assert recorded == now, "if this is meant: python -m tests.test_api, and a line in CHANGELOG.md"


if __name__ == "__main__":
    RECORD.write_text(surface())
