"""``make`` and the weights file: what was written comes back, and nothing else is taken for it."""

import inspect
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file, safe_open, save_file

from essjax import methods
from essjax.frames import example_frame
from essjax.interfaces import Method
from essjax.methods import registry, weights
from experiments.members import settings_of
from experiments.variants import VARIANTS

SMALL = methods.taau(scale=3, alpha=0.25)


def filled(method, seed=0):
    """Variables of the right shapes, each number another one."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(method.init, jax.random.key(0), example_frame(64, 36))
    return jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(leaf.dtype), shapes)


def test_every_factory_is_made_by_name():
    functions = {name: getattr(methods, name) for name in methods.__all__}
    makes = {name for name, f in functions.items() if inspect.signature(f).return_annotation is Method}
    assert makes - set(registry.FACTORIES) == {"composed", "make", "settled"}
    for name in sorted(set(registry.FACTORIES) - {"with_taa"}):
        made = methods.make(name)
        assert made.recipe.name == name and hash(made) is not None
        again = methods.make(made.recipe.name, **dict(made.recipe.arguments))
        assert again.recipe == made.recipe and again.info == made.info


def test_make_says_what_there_is():
    assert methods.make("extrass-e", width=8).recipe.arguments[0] == ("width", 8)
    with pytest.raises(ValueError, match=r"method: expected one of bicubic, bilinear, .*, with_taa; got 'extras'\."):
        methods.make("extras")
    with pytest.raises(ValueError, match=r"ifrnet: expected arguments among width; got widht, wide\."):
        methods.make("ifrnet", widht=8, wide=2)
    with pytest.raises(ValueError, match=r"warp-3d: expected arguments among none; got width\."):
        methods.make("warp-3d", width=8)


@pytest.mark.parametrize(
    "method",
    [
        SMALL,
        methods.warp(blur=1.5),
        methods.extrass_w(sigma_guide=[0.25] * 6),
        methods.with_taa(methods.ifrnet(width=4), alpha=np.float32(0.25)),
    ],
    ids=lambda method: method.info.name,
)
def test_a_file_gives_the_method_and_its_variables(method, tmp_path):
    path, variables = tmp_path / "weights.safetensors", filled(method)
    methods.save(path, method, jax.tree.map(jnp.asarray, variables))
    assert [file.name for file in tmp_path.iterdir()] == ["weights.safetensors"]
    again, read = methods.load(path)
    assert again.info == method.info and again.recipe.name == method.recipe.name
    assert jax.tree.structure(read) == jax.tree.structure(variables)
    jax.tree.map(np.testing.assert_array_equal, read, variables)


def test_others_can_read_it(tmp_path):
    path = tmp_path / "weights.safetensors"
    methods.save(path, SMALL, {"alpha": np.float32(0.5), "sigma": np.float32(0.75)})
    assert {name: float(value) for name, value in load_file(path).items()} == {"alpha": 0.5, "sigma": 0.75}
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["essjax"])
    assert header["method"] == "taau" and header["scale"] == 3 and header["inputs"] == []
    assert header["arguments"]["alpha"] == 0.25 and header["arguments"]["clamp"] == "ycocg"
    assert set(header) == {"format", "version", "method", "arguments", "inputs", "scale", "checksum"}


def test_every_flipped_bit_and_every_cut_is_one_error(tmp_path):
    path = tmp_path / "weights.safetensors"
    methods.save(path, SMALL, {"alpha": np.float32(0.5), "sigma": np.float32(0.75)})
    whole = path.read_bytes()
    wrong = [whole[:n] for n in range(0, len(whole), 7)] + [whole + b"0"]
    for n in range(len(whole)):
        flipped = bytearray(whole)
        flipped[n] ^= 1 << n % 8
        wrong.append(bytes(flipped))
    for content in wrong:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"expected a weights file that essjax\.methods\.save wrote; it is "):
            methods.load(path)


def rewritten(path, **changes):
    """The file with another header, its checksum made anew."""
    tensors = load_file(path)
    with safe_open(path, framework="numpy") as file:
        header = {**json.loads(file.metadata()["essjax"]), **changes}
    header.pop("checksum")
    header["checksum"] = weights._checksum(header, tensors)
    save_file(tensors, path, metadata={"essjax": json.dumps(header)})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": 2, "version": "9.0"}, "its format 2 is newer than 1. Update essjax to 9.0"),
        ({"method": "gone"}, "essjax 0.1.0 wrote it, and this one cannot make its method (method: expected one of"),
        ({"arguments": {"width": 2}}, "cannot make its method (taau: expected arguments among scale, "),
        ({"scale": 2}, "essjax 0.1.0 wrote it, whose taau is another one (inputs or scale differ)"),
        ({"inputs": ["stencil"]}, "whose taau is another one (inputs or scale differ). Train it again, or use that"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_file_of_another_version_says_so(changes, message, tmp_path):
    path = tmp_path / "weights.safetensors"
    methods.save(path, SMALL, {"alpha": np.float32(0.5), "sigma": np.float32(0.75)})
    rewritten(path, **changes)
    with pytest.raises(ValueError, match=re.escape(message)):
        methods.load(path)


def test_other_shapes_are_named(tmp_path):
    path = tmp_path / "weights.safetensors"
    methods.save(path, SMALL, {"alpha": np.float32(0.5), "sigma": np.ones(3, np.float32), "gain": np.float32(1)})
    with pytest.raises(ValueError, match=r"whose taau is another one \(gain, sigma differ\)\. Train it again"):
        methods.load(path)


def test_files_of_others_and_methods_of_others(tmp_path):
    foreign = tmp_path / "model.safetensors"
    save_file({"weight": np.ones(3, np.float32)}, foreign, metadata={"format": "pt"})
    text = tmp_path / "weights.safetensors"
    text.write_text("version https://git-lfs.github.com/spec/v1")
    for path, reason in (
        (foreign, "it is a safetensors file of another program"),
        (text, r"it is damaged or no safetensors file \("),
        (tmp_path / "none.safetensors", "there is no such file"),
    ):
        with pytest.raises(ValueError, match=rf"{path.name}: expected a weights file .*; {reason}"):
            methods.load(path)
    with pytest.raises(ValueError, match="taau: expected a method made by a factory of essjax.methods, got"):
        methods.save(tmp_path / "mine.safetensors", SMALL._replace(recipe=None), {})


@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_the_method_of_every_variant_is_made_again(name):
    method = VARIANTS[name].method(settings_of(name, "smoke"))
    assert weights._made(weights._described(method)).info == method.info
