"""Two methods in a row: the first makes a colour for every frame, the second takes it for rendered.

ExtraSS Table 3 feeds extrapolating methods at output resolution and smooths what they make: ``extranet_taa``. FASSET
Table 2 chains an extrapolating and a supersampling method.
"""

import dataclasses

from essjax.frames import Frame, Prediction
from essjax.interfaces import Method, MethodInfo
from essjax.methods.extranet import extranet
from essjax.methods.taau import taa
from essjax.typing import Callable, Color


def _with_color(frame: Frame, color: Color) -> Frame:
    return dataclasses.replace(frame, color=color)


def composed(
    name: str,
    first: Method,
    second: Method,
    *,
    native: bool = False,
    between: Callable[[Frame, Color], Frame] = _with_color,
) -> Method:
    """``second`` on the images of ``first``: whether a frame was rendered is ``first``'s matter alone.

    ``variables`` are those of both, side by side. ``aux`` is ``second``'s, and holds ``first``'s under ``"first"``.

    Args:
      name: of the whole.
      first: makes an image of every frame; it must not lag behind (``info.latency`` 0).
      second: its ``render_step`` sees every frame.
      native: frames are of the reference's resolution.
      between: ``(frame, first's image) -> frame`` for ``second``: the same frame with that colour, unless G-buffers,
        motion and jitter have to follow a change of size.

    Raises:
      ValueError: ``first`` lags behind.
    """
    if first.info.latency:
        raise ValueError(f"{name}: expected a first method without latency, got {first.info.name}.")

    def as_rendered(frame: Frame, color: Color) -> Frame:
        return between(frame, color)

    def init(key, example):
        both = first.init(key, example), second.init(key, as_rendered(example, _blank(first, example)))
        ...

    raise NotImplementedError
