"""Named arrays from weight files that others trained: NumPy's ``.npz``, ``.safetensors``, PyTorch's ``.pth``.

PyTorch's format is a pickle in a zip file. It is read without PyTorch and without running what the pickle names: only
what rebuilds tensors is let through. No file may declare much more than it holds: what is declared is bounded before
memory is taken for it.
"""

import collections
import json
import math
import pickle
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

SUFFIXES = (".safetensors", ".npz", ".pth", ".pt", ".pth.tar", ".pkl")
"""Endings of the files that ``read_tensors`` takes; all but the first two are PyTorch's."""

_SAFETENSORS_DTYPES = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2",
    "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "<i1", "U8": "<u1", "BOOL": "<?",
}  # fmt: skip
_STORAGES = {
    "DoubleStorage": "<f8", "FloatStorage": "<f4", "HalfStorage": "<f2", "BFloat16Storage": "<u2",
    "LongStorage": "<i8", "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "<i1", "ByteStorage": "<u1",
    "BoolStorage": "<?",
}  # fmt: skip


_SMALL = 64 << 20
"""A file may always declare this many bytes of arrays ..."""
_MOST = 20
"""... and this many more for each byte it has: weights are hardly compressible."""

_MOST_PICKLE = 4 << 20
"""Bytes of a pickle without its tensors: tens of thousands of names."""


def _allowed(path: Path) -> int:
    """Bytes that the arrays of a file may have in all."""
    return _SMALL + _MOST * path.stat().st_size


def _check_zip(path: Path, entries: Iterable[zipfile.ZipInfo]) -> None:
    """Raise a ValueError if a zip file would inflate to more than is allowed."""
    declared = sum(entry.file_size for entry in entries)
    if declared > _allowed(path):
        raise ValueError(f"it inflates to {declared >> 20} MB, more than weights of this size do")


def read_tensors(path: str | Path, what: str = "weights", *, prefix: str = "") -> dict[str, np.ndarray]:
    """Read the arrays of a weight file by name.

    A PyTorch file may hold a state dict or a checkpoint with one under ``state_dict``. bfloat16 becomes float32.

    Args:
      path: its ending says what it is, see ``SUFFIXES``.
      what: what the file should be, for messages.
      prefix: names that start otherwise are left out.

    Raises:
      ValueError: there is no such file, its ending is unknown, it is damaged, or it names code to run.
    """
    path = Path(path)
    suffix = next((s for s in SUFFIXES if path.name.endswith(s)), None)
    if not path.is_file() or suffix is None:
        got = f"{path}, which does not exist" if suffix else path.name
        raise ValueError(f"{what}: expected a file that ends in {', '.join(SUFFIXES)}; got {got}.")
    reader = {".npz": _read_npz, ".safetensors": _read_safetensors}.get(suffix, _read_torch)
    try:
        return reader(path, prefix)
    except Exception as error:  # damaged files raise whatever the libraries raise
        raise ValueError(f"{what}: {path} is damaged or not a {suffix} file ({error!s:.300}).") from error


def _read_npz(path: Path, prefix: str) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        _check_zip(path, archive.infolist())
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files if name.startswith(prefix)}


def _float32(bits: np.ndarray) -> np.ndarray:
    """bfloat16 is the upper half of a float32."""
    return (bits.astype("<u4") << 16).view("<f4")


def _read_safetensors(path: Path, prefix: str) -> dict[str, np.ndarray]:
    return {name: np.array(array) for name, array in map_safetensors(path).items() if name.startswith(prefix)}


def map_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Map the arrays of a safetensors file by name, read from the disk where they are used (bfloat16 at once).

    safetensors' own reader has no bfloat16 for NumPy and copies everything.
    """
    data = np.memmap(path, np.uint8, mode="r")
    header_end = 8 + int.from_bytes(data[:8].tobytes(), "little")
    tensors, total = {}, 0
    for name, entry in json.loads(data[8:header_end].tobytes()).items():
        if name == "__metadata__":
            continue
        if entry["dtype"] not in _SAFETENSORS_DTYPES:
            raise ValueError(f"{name} has dtype {entry['dtype']}, expected {', '.join(_SAFETENSORS_DTYPES)}")
        begin, end = entry["data_offsets"]
        total += end - begin
        if not 0 <= begin <= end or total > data.size:
            raise ValueError(f"{name} lies at {begin}..{end}, and the file has {data.size} bytes for all")
        raw = data[header_end + begin : header_end + end]
        array = np.frombuffer(raw, _SAFETENSORS_DTYPES[entry["dtype"]]).reshape(entry["shape"])
        tensors[name] = _float32(array) if entry["dtype"] == "BF16" else array
    return tensors


def _read_torch(path: Path, prefix: str) -> dict[str, np.ndarray]:
    if not zipfile.is_zipfile(path):
        raise ValueError("not a zip file; files older than PyTorch 1.6 must be saved again by a newer one")
    with zipfile.ZipFile(path) as archive:
        _check_zip(path, archive.infolist())
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError(f"expected one data.pkl in it, found {len(pickles)}")
        if archive.getinfo(pickles[0]).file_size > _MOST_PICKLE:
            raise ValueError("its data.pkl is larger than that of any state dict")
        folder = pickles[0].removesuffix("data.pkl")
        if f"{folder}byteorder" in archive.namelist() and archive.read(f"{folder}byteorder") != b"little":
            raise ValueError("big-endian storages are not supported")
        with archive.open(pickles[0]) as file:
            content = _Unpickler(file, archive, folder, _allowed(path)).load()
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping):
        raise ValueError(f"expected a state dict, got a {type(content).__name__}")
    return {
        name: tensor
        for name, tensor in content.items()
        if isinstance(name, str) and isinstance(tensor, np.ndarray) and name.startswith(prefix)
    }


def _rebuild_parameter(tensor: np.ndarray, *_) -> np.ndarray:
    return tensor


def _build(unpickler: "_Unpickler") -> None:
    """Take the attributes of an object (a state dict's ``_metadata``) off the stack, and leave them."""
    unpickler.stack.pop()


class _Unpickler(pickle._Unpickler):  # the one in Python: the one in C takes memory for what an index of its memo says
    """Lets a pickle call nothing but what builds dictionaries and tensors, and these of bounded size."""

    dispatch = {**pickle._Unpickler.dispatch, pickle.BUILD[0]: _build}
    for _opcode in (pickle.BYTEARRAY8, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER):  # protocol 5; PyTorch writes 2
        del dispatch[_opcode[0]]

    def __init__(self, file: Any, archive: zipfile.ZipFile, folder: str, allowed: int):
        super().__init__(file)
        self._archive, self._folder, self._left = archive, folder, allowed
        self._storages: dict[tuple, np.ndarray] = {}
        self._known = {
            ("collections", "OrderedDict"): collections.OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): self._rebuild_tensor,
            ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
            **{("torch", name): name for name in _STORAGES},
        }

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Look up what a name in the pickle stands for."""
        if (module_name, global_name) not in self._known:
            raise ValueError(f"it names {module_name}.{global_name}, which a state dict does not need: not loaded")
        return self._known[module_name, global_name]

    def persistent_load(self, pid: Any) -> np.ndarray:
        """Read a storage from its own file in the archive, once."""
        kind, storage, key, _, count = pid
        if kind != "storage" or storage not in _STORAGES:
            raise ValueError(f"unknown entry {kind} {storage}")
        if (storage, key) not in self._storages:
            name = f"{self._folder}data/{key}"
            self._take(self._archive.getinfo(name).file_size)
            array = np.frombuffer(self._archive.read(name), _STORAGES[storage])
            self._storages[storage, key] = _float32(array) if storage == "BFloat16Storage" else array
        array = self._storages[storage, key]
        if array.size != count:
            raise ValueError(f"storage {key} holds {array.size} numbers, expected {count}")
        return array

    def _rebuild_tensor(
        self, storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
    ) -> np.ndarray:
        """Copy a strided view of a storage. Its bounds are checked: a file must not read other memory, nor fill it."""
        if not isinstance(storage, np.ndarray) or storage.ndim != 1:
            raise ValueError("a tensor without a storage")
        numbers = (offset, *size, *stride)
        fits = len(size) <= 32 and all(type(number) is int and 0 <= number < 1 << 48 for number in numbers)
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True)) if fits else math.inf
        if not fits or math.prod(size) and last >= storage.size:
            raise ValueError(f"a tensor of size {size} and stride {stride} at {offset} leaves its storage")
        self._take(math.prod(size) * storage.itemsize)
        steps = [step * storage.itemsize for step in stride]
        return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()

    def _take(self, count: int) -> None:
        """Count bytes that are about to be taken."""
        self._left -= count
        if self._left < 0:
            raise ValueError("its tensors are larger in all than weights in a file of this size are")
