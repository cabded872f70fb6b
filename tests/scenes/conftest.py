"""Hand-built scenes whose images can be computed with pencil and paper."""

import numpy as np
import pytest

from essjax.scenes import presets
from essjax.scenes.builder import Builder
from essjax.scenes.materials import Material

BLACK = {"zenith": (0, 0, 0), "horizon": (0, 0, 0), "ground": (0, 0, 0), "ambient": 0.0}
FOCAL = 0.9


@pytest.fixture
def builder():
    """A Builder of 6 frames at the origin looking along -z, black sky, no light."""
    b = Builder(6, np.random.default_rng(0))
    b.set_sky(**BLACK)
    b.set_camera((0, 0, 0), (0, 0, -1), focal=FOCAL)
    return b


@pytest.fixture
def white():
    """A material of radiance 1."""
    return Material(a=(1.0, 1.0, 1.0), grime=0.0, emission=1.0)


@pytest.fixture
def moving_box(builder):
    """A box that moves right by 0.3 m per frame at 5 m, before a wall at 8 m, lit by a lamp that moves as well."""
    steps = np.arange(builder.frames)
    builder.rect(presets.bricks((0.6, 0.4, 0.3)), (0, 0, -8), 20, 20)
    place = np.stack([-0.9 + 0.3 * steps, 0.0 * steps, -5.5 + 0.0 * steps], axis=-1)
    builder.box(presets.plaster((0.2, 0.5, 0.7)), place, (0.8, 0.6, 0.5))
    builder.lamp(np.stack([-1.0 + 0.4 * steps, 2.0 + 0.0 * steps, -2.0 + 0.0 * steps], axis=-1), (40, 40, 40))
    return builder.build("moving box", 0)
