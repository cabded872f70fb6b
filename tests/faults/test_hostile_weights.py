"""Weight files that are damaged, or made to harm: one ValueError each, in bounded time and memory."""

import pickle
import struct
import zipfile

import numpy as np
import pytest

import essjax.tensors
from essjax.losses.vgg import vgg16_features
from essjax.methods import extranet_from_torch
from essjax.tensors import read_tensors
from tests.test_tensors import Call, checkpoint, save_torch, tensor

STORAGE = np.arange(12, dtype=np.float32)


def with_pickle(path, content):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", content)
        archive.writestr("archive/data/0", STORAGE.tobytes())
    return path


def refused(path, match, read=read_tensors):
    with pytest.raises(ValueError, match=match) as caught:
        read(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def damaged(content, random):
    """One to four bytes changed; of some the end is missing."""
    content = bytearray(content)
    for at in random.integers(0, len(content), random.integers(1, 5)):
        content[at] = random.integers(256)
    return bytes(content[: len(content) - int(random.integers(0, 90)) * int(random.integers(2))])


def test_random_damage_is_one_error(tmp_path):
    """Or none: a flip in an unused byte. On the old code one in thirty raised something else."""
    whole = checkpoint(tmp_path / "whole.pth", {"a": np.ones((3, 5), np.float32), "b": STORAGE})
    content, path, random = whole.read_bytes(), tmp_path / "damaged.pth", np.random.default_rng(3)
    with zipfile.ZipFile(whole) as archive:
        inner = archive.read("archive/data.pkl")
    refusals = 0
    for number in range(600):
        if number % 2:  # with sums that fit: else zip finds it before the reader does
            with_pickle(path, damaged(inner, random))
        else:
            path.write_bytes(damaged(content, random))
        try:
            read_tensors(path)
        except ValueError as error:
            assert str(path) in str(error)
            refusals += 1
    assert refusals > 300


def test_a_zip_that_inflates(tmp_path, monkeypatch):
    monkeypatch.setattr(essjax.tensors, "_SMALL", 1 << 20)
    for suffix in (".pth", ".npz"):
        path = tmp_path / f"bomb{suffix}"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("archive/data.pkl", bytes(30 << 20))
        refused(path, r"it inflates to 30 MB, more than weights of this size do")
    path = with_pickle(tmp_path / "long.pth", bytes(5 << 20))
    refused(path, "its data.pkl is larger than that of any state dict")


def test_tensors_larger_than_the_file(tmp_path, monkeypatch):
    """One number read 2^40 times, and a storage copied a thousand times."""
    endless = {"x": tensor("FloatStorage", "0", STORAGE, (1 << 20, 1 << 20), (0, 0))}
    path = save_torch(tmp_path / "endless.pth", endless, [("0", STORAGE)])
    refused(path, "its tensors are larger in all than weights in a file of this size are")
    monkeypatch.setattr(essjax.tensors, "_SMALL", 1 << 10)
    many = {f"x{n}": tensor("FloatStorage", "0", STORAGE, (12, 1000), (1, 0)) for n in range(9)}
    path = save_torch(tmp_path / "many.pth", many, [("0", STORAGE)])
    refused(path, "its tensors are larger in all")
    monkeypatch.setattr(essjax.tensors, "_SMALL", 64 << 20)
    assert read_tensors(path)["x8"].shape == (12, 1000)
    high = {"x": tensor("FloatStorage", "0", STORAGE, (1,) * 40, (1,) * 40)}
    refused(save_torch(tmp_path / "axes.pth", high, [("0", STORAGE)]), "leaves its storage")
    inner = tensor("FloatStorage", "0", STORAGE, (3, 4), (4, 1))
    outer = Call(inner.function, inner, 2, (4,), (1,), False, {})  # an offset would count rows of it: out of its memory
    refused(save_torch(tmp_path / "rows.pth", {"x": outer}, [("0", STORAGE)]), "a tensor without a storage")


def test_pickles_that_only_take_memory(tmp_path):
    """A memo with two billion places, an array of a petabyte: the machine's memory, before a byte of it is read."""
    memo = b"\x80\x02}" + pickle.LONG_BINPUT + struct.pack("<I", 2**31 - 1) + b"."
    assert read_tensors(with_pickle(tmp_path / "memo.pth", memo)) == {}
    array = b"\x80\x05" + pickle.BYTEARRAY8 + struct.pack("<Q", 1 << 50) + b"."
    refused(with_pickle(tmp_path / "array.pth", array), "is damaged or not a .pth file")
    text = b"\x80\x04" + pickle.BINUNICODE8 + struct.pack("<Q", 1 << 50) + b"."
    refused(with_pickle(tmp_path / "text.pth", text), "is damaged or not a .pth file")


def test_attributes_are_not_set(tmp_path):
    """``_metadata`` of a state dict is left out; anything else would shadow the methods of a dictionary."""
    state = b"\x80\x02ccollections\nOrderedDict\n)R}X\x05\x00\x00\x00itemsK\x01sb."
    assert read_tensors(with_pickle(tmp_path / "state.pth", state)) == {}


def test_safetensors_that_overlap(tmp_path):
    """Many names for the same bytes are many copies of them."""
    entry = '{"dtype":"F32","shape":[12],"data_offsets":[0,48]}'
    path = tmp_path / "same.safetensors"
    values, entry = np.zeros(1000, np.float32), entry.replace("12", "1000").replace("48", "4000")
    header = f'{{"a":{entry},"b":{entry}}}'.encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + values.tobytes())
    refused(path, r"b lies at 0\.\.4000, and the file has \d+ bytes for all")
    header = entry.replace("[0,4000]", "[-48,0]").join(['{"a":', "}"]).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + STORAGE.tobytes())
    refused(path, "a lies at -48..0")
    header = b'{"a":' * 100_000
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    refused(path, "is damaged or not a .safetensors file")


def test_objects_in_an_npz_are_refused_by_name(tmp_path):
    """``--set training.vgg=PATH``: nothing in it runs."""
    path = tmp_path / "vgg.npz"
    np.savez(path, **{"features.0.weight": np.array([print, {}], object)})
    refused(path, "VGG-16 weights: .*Object arrays cannot be loaded", vgg16_features)
    np.save(tmp_path / "vgg.npy", np.ones(3))
    (tmp_path / "vgg.npy").rename(path)
    refused(path, "VGG-16 weights: .* is damaged or not a .npz file", vgg16_features)


def test_published_weights_that_are_others(tmp_path):
    path = checkpoint(tmp_path / "a.pth.tar", {"a": STORAGE})
    with pytest.raises(ValueError, match="expected"):
        extranet_from_torch(path)
