"""Weight files of other programs: PyTorch's zip format, written here byte by byte as PyTorch writes it.

The other two formats: tests/losses/test_perceptual.py.
"""

import collections
import io
import pickle
import zipfile

import numpy as np
import pytest

from essjax.tensors import read_tensors


class Global:
    """Pickles as a name of another module that is not installed."""

    def __init__(self, module, name):
        self.name = f"c{module}\n{name}\n".encode()


class Call:
    """Pickles as a call of a ``Global``."""

    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments


class Storage:
    """Pickles as a reference to an array in a file of its own."""

    def __init__(self, kind, key, array):
        self.kind, self.key, self.array = kind, key, array


class TorchPickler(pickle._Pickler):
    """Protocol 2 with persistent ids for storages, as ``torch.save`` uses it."""

    def persistent_id(self, obj):
        if isinstance(obj, Storage):
            return ("storage", Global("torch", obj.kind), obj.key, "cpu", obj.array.size)
        return None

    def save(self, obj, save_persistent_id=True):
        if isinstance(obj, Global):
            self.write(obj.name)
        elif isinstance(obj, Call):
            self.write(obj.function.name)
            super().save(obj.arguments)
            self.write(pickle.REDUCE)
        else:
            super().save(obj, save_persistent_id)


def tensor(kind, key, storage, size, stride, offset=0):
    rebuild = Global("torch._utils", "_rebuild_tensor_v2")
    return Call(rebuild, Storage(kind, key, storage), offset, size, stride, False, collections.OrderedDict())


def save_torch(path, content, storages=(), folder="archive"):
    stream = io.BytesIO()
    TorchPickler(stream, 2).dump(content)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{folder}/data.pkl", stream.getvalue())
        for key, array in storages:
            archive.writestr(f"{folder}/data/{key}", array.tobytes())
    return path


def checkpoint(path, tensors):
    """A checkpoint with a contiguous float32 or int64 storage per tensor, and things that are no tensors."""
    content, storages = collections.OrderedDict(), []
    for key, (name, array) in enumerate(tensors.items()):
        kind = {"float32": "FloatStorage", "int64": "LongStorage"}[str(array.dtype)]
        stride = tuple(step // array.itemsize for step in np.empty(array.shape, array.dtype).strides)
        content[name] = tensor(kind, str(key), np.ravel(array), array.shape, stride)
        storages.append((str(key), np.ravel(array)))
    return save_torch(path, {"epoch": 3, "state_dict": content, "optimizer": {"lr": [0.1, None]}}, storages)


def test_checkpoint_of_pytorch(tmp_path):
    weights = {
        "a.weight": np.arange(24, dtype=np.float32).reshape(2, 3, 4),
        "a.count": np.array(7, np.int64),
        "b.bias": np.array([0.5, -2.0], np.float32),
    }
    path = checkpoint(tmp_path / "model.pth.tar", weights)
    found = read_tensors(path)
    assert list(found) == list(weights)
    for name, array in weights.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    assert list(read_tensors(path, prefix="b.")) == ["b.bias"]


def test_views_parameters_and_small_floats(tmp_path):
    """A transposed view with an offset, a Parameter, float16 and bfloat16."""
    storage, half = np.arange(10, dtype=np.float32), np.array([1.5, -3.0], np.float16)
    upper = (np.array([1.0, -2.5, 3e38], np.float32).view(np.uint32) >> 16).astype(np.uint16)
    parameter = Call(
        Global("torch._utils", "_rebuild_parameter"), tensor("FloatStorage", "0", storage, (2, 3), (1, 2), 3), True
    )
    content = {"view": parameter, "half": tensor("HalfStorage", "1", half, (2,), (1,)),
               "brain": tensor("BFloat16Storage", "2", upper, (3,), (1,))}  # fmt: skip
    path = save_torch(tmp_path / "model.pt", content, [("0", storage), ("1", half), ("2", upper)], folder="any name")
    found = read_tensors(path)
    np.testing.assert_array_equal(found["view"], [[3, 5, 7], [4, 6, 8]])
    np.testing.assert_array_equal(found["half"], half)
    np.testing.assert_allclose(found["brain"], [1.0, -2.5, 3e38], rtol=1e-2)


def test_a_pickle_that_runs_code_is_refused(tmp_path):
    witness = tmp_path / "witness"
    for k, (module, name) in enumerate([("os", "system"), ("builtins", "eval"), ("torch", "load")]):
        path = save_torch(tmp_path / f"{k}.pth", {"x": Call(Global(module, name), f"touch {witness}")})
        with pytest.raises(ValueError, match=f"it names {module}.{name}, which a state dict does not need: not loaded"):
            read_tensors(path)
    assert not witness.exists()


def test_messages(tmp_path):
    storage = np.zeros(4, np.float32)
    outside = {"x": tensor("FloatStorage", "0", storage, (2, 2), (2, 2))}
    with pytest.raises(ValueError, match=r"size \(2, 2\) and stride \(2, 2\) at 0 leaves its storage"):
        read_tensors(save_torch(tmp_path / "outside.pth", outside, [("0", storage)]))
    negative = {"x": tensor("FloatStorage", "0", storage, (2,), (1,), -1)}
    with pytest.raises(ValueError, match="leaves its storage"):
        read_tensors(save_torch(tmp_path / "negative.pth", negative, [("0", storage)]))
    short = {"x": tensor("FloatStorage", "0", storage, (4,), (1,))}
    with pytest.raises(ValueError, match="storage 0 holds 3 numbers, expected 4"):
        read_tensors(save_torch(tmp_path / "short.pth", short, [("0", storage[:3])]))
    with pytest.raises(ValueError, match="expected a state dict, got a list"):
        read_tensors(save_torch(tmp_path / "list.pth", [1, 2]))
    old = tmp_path / "old.pth"
    old.write_bytes(pickle.dumps({}))
    with pytest.raises(ValueError, match="files older than PyTorch 1.6 must be saved again by a newer one"):
        read_tensors(old, "ExtraNet")
    with pytest.raises(ValueError, match="ExtraNet: expected a file that ends in .safetensors, .*got .*no.pth, which"):
        read_tensors(tmp_path / "no.pth", "ExtraNet")
    whole = checkpoint(tmp_path / "whole.pth", {"a": storage}).read_bytes()
    old.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="old.pth is damaged or not a .pth file"):
        read_tensors(old)
