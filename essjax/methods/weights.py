"""The weights file: a method and its trained variables in one safetensors file, and how to make the method again."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

import essjax
from essjax.files import atomic
from essjax.frames import Frame, example_frame
from essjax.interfaces import Method
from essjax.methods.registry import make
from essjax.sizes import Scale
from essjax.typing import PyTree

FORMAT = 1
"""Format of the header; a larger number is refused."""
KEY = "essjax"
"""Name of the header in the file's ``__metadata__``."""


def save(path: str | Path, method: Method, variables: PyTree) -> None:
    """Write ``method`` and its trained ``variables`` to ``path``, at once or not at all.

    Any safetensors reader opens the file. Its header, JSON under ``essjax`` in the metadata, has the ``format``, the
    ``version`` of essjax, the ``method`` and its ``arguments``, the ``inputs`` (buffers that frames must have beside
    colour and motion), the ``scale`` and a ``checksum`` (SHA-256 of all else).

    Args:
      path: such as ``weights.safetensors``; its folder is made.
      method: from a factory of ``essjax.methods``.
      variables: dictionaries of arrays, as ``method.init`` makes them.

    Raises:
      ValueError: the method is not one that ``make`` makes, or the file cannot be written.
    """
    path, tensors = Path(path), _flat(variables)
    header = {"format": FORMAT, "version": essjax.__version__, **_described(method), **_facts(method)}
    header["checksum"] = _checksum(header, tensors)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        try:
            save_file(tensors, temporary, metadata={KEY: json.dumps(header)})
        except SafetensorError as error:  # of the disk
            raise ValueError(f"{path}: cannot write the weights ({error}). Is the disk full?") from error


def load(path: str | Path, *, scale: Scale | None = None) -> tuple[Method, PyTree]:
    """Read what ``save`` wrote: the method, made again, and its variables.

    Args:
      path: of the file.
      scale: make the method for another size of output, with the same variables (``extrass``, ``fasset``, ``nsrr``);
        None: as it was saved.

    Raises:
      ValueError: there is no such file; it is not a weights file, damaged, or of another version of the method; or the
        method has no scale, or not that one.
    """
    path = Path(path)

    def refuse(reason: str) -> NoReturn:
        raise ValueError(f"{path}: expected a weights file that essjax.methods.save wrote; {reason}.")

    if not path.is_file():
        refuse("there is no such file")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get(KEY, "null"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dictionary
    except (SafetensorError, ValueError, KeyError, TypeError, OSError) as error:
        refuse(f"it is damaged or no safetensors file ({error})")
    if not isinstance(header, dict) or "format" not in header:
        refuse("it is a safetensors file of another program")
    if header.pop("checksum", None) != _checksum(header, tensors):
        refuse("it is damaged: its checksum does not fit. Copy it again")
    if header["format"] > FORMAT:
        refuse(f"its format {header['format']} is newer than {FORMAT}. Update essjax to {header['version']}")
    try:
        method = _made(header)
        wanted = _flat(jax.eval_shape(method.init, jax.random.key(0), _example(method)))
    except ValueError as error:
        refuse(f"essjax {header['version']} wrote it, and this one cannot make its method ({error})")
    shapes = [{name: (leaf.shape, str(leaf.dtype)) for name, leaf in each.items()} for each in (tensors, wanted)]
    different = sorted(name for name in {**tensors, **wanted} if shapes[0].get(name) != shapes[1].get(name))
    if different or any(header[name] != value for name, value in _facts(method).items()):
        refuse(
            f"essjax {header['version']} wrote it, whose {header['method']} is another one "
            f"({', '.join(different[:3]) or 'inputs or scale'} differ). Train it again, or use that version"
        )
    return method if scale is None else _rescaled(method, scale), _nested(tensors)


def _rescaled(method: Method, scale: Scale) -> Method:
    """Make ``method`` again with another ``scale``."""
    assert method.recipe is not None
    arguments = dict(method.recipe.arguments)
    if "scale" not in arguments:
        raise ValueError(f"scale: {method.info.name} has none, its output has the input's size. Leave it out.")
    return make(method.recipe.name, **{**arguments, "scale": scale})


def _described(method: Method) -> dict[str, Any]:
    """Name and arguments of a method, as JSON has them; an argument may be a method."""
    if method.recipe is None:
        raise ValueError(f"{method.info.name}: expected a method made by a factory of essjax.methods, got another one.")
    arguments = {k: _described(v) if isinstance(v, Method) else v for k, v in method.recipe.arguments}
    return json.loads(json.dumps({"method": method.recipe.name, "arguments": arguments}))


def _made(described: Mapping[str, Any]) -> Method:
    arguments = {k: _made(v) if isinstance(v, dict) else v for k, v in described["arguments"].items()}
    return make(described["method"], **arguments)


def _facts(method: Method) -> dict[str, Any]:
    scale = method.info.scale
    return {"inputs": sorted(method.info.requires), "scale": list(scale) if isinstance(scale, tuple) else scale}


def _example(method: Method) -> Frame:
    """Make a frame that is not larger than the method's output."""
    scale = method.info.scale
    return example_frame(*(map(min, scale, (64, 36)) if isinstance(scale, tuple) else (64, 36)))


def _flat(variables: PyTree) -> dict[str, Any]:
    """Leaves by the names on the way to them, ``frnet/params/...``."""
    leaves = jax.tree_util.tree_leaves_with_path(variables)
    return {"/".join(str(key.key) for key in path): _host(leaf) for path, leaf in leaves}


def _host(leaf: Any) -> Any:
    return leaf if isinstance(leaf, jax.ShapeDtypeStruct) else np.asarray(jax.device_get(leaf), order="C")


def _nested(tensors: Mapping[str, np.ndarray]) -> dict[str, Any]:
    variables: dict[str, Any] = {}
    for name, tensor in tensors.items():
        *folders, last = name.split("/")
        inner = variables
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[last] = tensor
    return variables


def _checksum(header: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tensor.shape}\n".encode())
        digest.update(tensor.tobytes())
    return digest.hexdigest()
