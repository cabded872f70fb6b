"""A ship at anchor: ropes, railings and spars thinner than a pixel before a plain sky, over calm water.

Not part of the splits: a hard case for methods that compare jittered G-buffers, in which a rope is in one frame and not
in the next.
"""

import numpy as np

from essjax.scenes import presets
from essjax.scenes.builder import FLOOR, Builder, between, rotation
from essjax.scenes.indoor import path, swing
from essjax.scenes.materials import Material

PIVOT = np.array([0.0, 0.2, 0.0])
"""The axis that the ship rolls about: its waterline."""


class _Ship:
    """Adds parts that are fixed to a ship which rolls by ``turn`` ``[T, 3, 3]``: one object of the stencil."""

    def __init__(self, b: Builder, turn: np.ndarray):
        self.b, self.turn, self.id = b, turn, b.new_id()

    def place(self, position, own) -> dict:
        at = self.turn @ (np.asarray(position, float) - PIVOT) + PIVOT
        return {"position": at, "turn": self.turn @ own, "object_id": self.id}

    def block(self, material: Material, position, half, own=None) -> None:
        self.b.box(material, half=half, **self.place(position, np.eye(3) if own is None else own))

    def rope(self, material: Material, start, end, radius: float) -> None:
        position, own, half = between(start, end)
        self.b.rod(material, radius=radius, half_length=half, **self.place(position, own))

    def lath(self, material: Material, start, end, radius: float) -> None:
        """Add a rope of square section: there are more boxes than rods to spare."""
        position, own, half = between(start, end)
        self.block(material, position, (radius, radius, half), own)


def _mast(ship: _Ship, materials: dict[str, Material], x: float, top: float, rows: int) -> None:
    """Build a mast with two yards, their lifts, and shrouds with ratlines on both sides."""
    wood, tar, hemp = materials["wood"], materials["tar"], materials["hemp"]
    ship.rope(wood, (x, 0.5, 0), (x, top, 0), 0.08)
    for height, reach in ((0.55 * top, 1.5), (0.82 * top, 1.05)):
        # Square to the wind, so that they are seen from the side, too.
        ends = [np.array([x + side * 0.75 * reach, height, side * 0.66 * reach]) for side in (-1, 1)]
        ship.rope(wood, *ends, 0.05)
        for end in ends:
            ship.rope(hemp, end, (x, height + 0.16 * top, 0), 0.016)
    for side in (-1, 1):
        feet = [np.array([x + 0.32 * k - 0.1, 0.75, side * 0.95]) for k in range(4)]
        head = np.array([x, 0.78 * top, side * 0.06])
        for foot in feet:
            ship.rope(tar, foot, head, 0.024)
        for k in range(rows):
            share = (k + 1) / (rows + 2)
            ends = [foot + share * (head - foot) for foot in (feet[0], feet[-1])]
            ship.lath(hemp, *ends, 0.014)


def rigging(b: Builder) -> None:
    """Build a rigged ship seen by a camera that circles it; it rolls slowly, as one rigid body."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.bounces = 1
    zenith, horizon = (((0.3, 0.5, 0.95), (0.85, 0.93, 1.0)), ((0.75, 0.78, 0.84), (0.95, 0.95, 0.95)))[rng.integers(2)]
    b.set_sky(zenith=zenith, horizon=horizon, ground=(0.1, 0.15, 0.17), clouds=0.0, ambient=0.45)
    water = Material(
        a=(0.02, 0.05, 0.06), grime=0.1, grime_frequency=0.35, bump=0.05, roughness=0.1, mirror=1.0
    )  # fmt: skip
    b.rect(water, (0, 0, 0), 80, 80, FLOOR)
    ship = _Ship(b, rotation("x", swing(b, 0.035, rng.uniform(0.006, 0.01))))
    materials = {
        "wood": Material(a=(0.16, 0.08, 0.04), roughness=0.6),
        "tar": Material(a=(0.03, 0.025, 0.02), grime=0.1, roughness=0.8),
        "hemp": Material(a=(0.12, 0.09, 0.06), grime=0.1, roughness=0.9),
        "white": Material(a=(0.85, 0.83, 0.78), grime=0.1, roughness=0.5),
    }
    hull = presets.planks(presets.shade(colors[0], 0.5), frequency=1.5)
    ship.block(hull, (0.0, 0.2, 0), (3.9, 0.45, 0.85))
    ship.block(presets.paint(colors[1]), (0.0, 0.7, 0), (4.05, 0.05, 0.95))
    ship.block(presets.planks(presets.shade(colors[2], 0.7)), (-3.3, 0.95, 0), (0.5, 0.2, 0.6))
    masts = ((-2.3, 5.0, 4), (0.2, 6.0, 6), (2.5, 5.3, 5))
    tops = []
    for x, top, rows in masts:
        top += rng.uniform(-0.2, 0.2)
        tops.append(np.array([x, top, 0.0]))
        _mast(ship, materials, x, top, rows)
    bow, stern = np.array([5.4, 1.9, 0.0]), np.array([-4.0, 0.8, 0.0])
    ship.rope(materials["wood"], (3.6, 0.75, 0), bow, 0.06)
    for foot, share in ((bow, 0.98), (bow, 0.75), ((4.4, 1.2, 0), 0.6)):
        ship.rope(materials["tar"], foot, tops[2] * (1, share, 1), 0.02)
    for k in (0, 1):
        ship.rope(materials["tar"], tops[k] * (1, 0.96, 1), tops[k + 1] * (1, 0.7, 1), 0.02)
    ship.rope(materials["hemp"], stern, tops[0] * (1, 0.97, 1), 0.016)
    for side in (-1, 1):
        for height, radius in ((1.0, 0.014), (1.2, 0.024)):
            ship.rope(materials["white"], (-3.9, height, side * 0.92), (3.9, height, side * 0.92), radius)
    for k in range(15):  # posts of the near and the far railing, in turn
        x = -3.9 + 7.8 * k / 14
        ship.lath(materials["white"], (x, 0.7, 0.92 - 1.84 * (k % 2)), (x, 1.2, 0.92 - 1.84 * (k % 2)), 0.016)
    b.sun((rng.uniform(-0.6, 0.6), 0.8, 0.7), (5.0, 4.6, 4.0))
    angle = swing(b, 1.1, rng.uniform(0.045, 0.065))
    reach = rng.uniform(8.8, 10.2) + swing(b, 0.8, 0.05)
    eye = path(reach * np.sin(angle), rng.uniform(1.6, 2.6) + swing(b, 0.4, 0.03), reach * np.cos(angle))
    b.set_camera(eye, path(swing(b, 0.8, 0.05), rng.uniform(1.6, 2.0), 0.0), focal=rng.uniform(0.8, 0.92))
