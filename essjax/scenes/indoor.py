"""Families with walls: corridor, carousel, gloss.

Metres and ``Builder.time``; speeds are chosen for 0.02 to 0.05 image widths per unit of time, that is 2 to 5 pixels of
192 per frame.
"""

import numpy as np

from essjax.scenes import presets
from essjax.scenes.builder import FLOOR, Builder, rotation


def swing(b: Builder, amplitude: float, speed: float) -> np.ndarray:
    """``[T]``: back and forth within ``amplitude`` (a length or an angle), random phase.

    A rounded triangle wave: nearly always at ``speed`` per unit of time, so that few frames show no motion.
    """
    sharpness = 0.96
    rate = 0.5 * np.pi * speed / (amplitude * sharpness)
    wave = np.sin(b.rng.uniform(0, 2 * np.pi) + rate * b.time)
    return amplitude * np.arcsin(sharpness * wave) / np.arcsin(sharpness)


def turning(b: Builder, speed: float) -> np.ndarray:
    """``[T]``: an angle growing by ``speed`` (radians) per unit of time from a random start."""
    return b.rng.uniform(0, 2 * np.pi) + speed * b.time


def path(x, y, z) -> np.ndarray:
    """``[T, 3]`` from components, each ``[T]`` or a number."""
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).astype(float)


def corridor(b: Builder) -> None:
    """Build a hall of pillars that the camera flies through: perspective motion and large disocclusions."""
    rng, colors = b.rng, presets.palette(b.rng)
    width, height = rng.uniform(2.2, 2.8), rng.uniform(3.0, 3.6)
    b.set_sky(
        ground=(0.3, 0.27, 0.24), ambient=0.22, clouds=0.55, sun_direction=(0.2, 0.35, -1.0), sun_color=(30, 24, 16)
    )
    b.rect(presets.tiles(presets.shade(colors[0], 0.8), (0.1, 0.1, 0.1), frequency=1.4), (0, 0, -8), 5, 22, FLOOR)
    b.rect(presets.planks(presets.shade(colors[1], 0.6)), (0, height, -8), 5, 22, rotation("x", np.pi / 2))
    wall = presets.bricks(colors[2], frequency=1.8)
    b.rect(wall, (-width - 0.9, height / 2, -8), 22, height / 2, rotation("y", np.pi / 2))
    b.rect(presets.plaster(colors[3]), (width + 0.9, height / 2, -8), 22, height / 2, rotation("y", -np.pi / 2))
    stone = presets.stone(presets.shade(colors[4], 0.9), presets.shade(colors[4], 0.45))
    for k in range(9):
        z = 6.0 - 3.4 * k
        for side in (-1, 1):
            b.box(stone, (side * width, height / 2, z + rng.uniform(-0.3, 0.3)), (0.28, height / 2, 0.28))
        if k % 2:
            glow = presets.screen(presets.shade(colors[k % 5], 1.3), strength=6.0)
            b.rect(glow, (-width - 0.88, 1.7, z - 1.7), 1.1, 0.6, rotation("y", np.pi / 2))
        else:
            b.rect(presets.glyphs((0.85, 0.82, 0.74), (0.06, 0.05, 0.05), frequency=5.0),
                   (width + 0.88, 1.6, z - 1.7), 0.9, 0.7, rotation("y", -np.pi / 2))  # fmt: skip
    for _ in range(9):
        side, size = rng.choice((-1, 1)), rng.uniform(0.2, 0.45)
        crate = presets.decorated(rng, colors[rng.integers(5)], colors[rng.integers(5)])
        spot = (side * rng.uniform(0.8, width), size, rng.uniform(-22, 3))
        b.box(crate, spot, (size, size, size), rotation("y", rng.uniform(0, 3)))
    for y in (height - 0.25, height - 0.45):
        b.bar(presets.metal((0.75, 0.45, 0.3)), (-1.2, y, 14), (-1.2, y, -30), 0.06)
    for k in range(6):
        b.box(presets.lamp((1.0, 0.86, 0.66), 9.0), (0, height - 0.06, 4 - 5 * k), (0.5, 0.03, 0.12))
    b.lamp((0.3, height - 0.4, 0.0), (34, 29, 22))
    b.lamp((-0.4, height - 0.4, -12.0), (38, 27, 18))
    forward, sway = swing(b, 7.0, rng.uniform(0.22, 0.3)), swing(b, 1.2, rng.uniform(0.09, 0.14))
    eye = path(sway, 1.5 + swing(b, 0.25, 0.02), -2.0 + forward)
    target = eye + path(swing(b, 0.5, 0.035), swing(b, 0.08, 0.008), -1.0)
    b.set_camera(eye, target, focal=rng.uniform(0.75, 0.95))


def carousel(b: Builder) -> None:
    """Build a turning platform with spinning objects in front of walls full of detail."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.set_sky(ambient=0.4, clouds=0.6)
    b.rect(presets.planks(presets.shade(colors[0], 0.7)), (0, 0, 0), 12, 12, FLOOR)
    b.rect(presets.bricks(colors[1], frequency=1.6), (0, 3, -5.5), 14, 3, None)
    for k, x in enumerate((-4.4, 0.0, 4.4)):
        poster = (
            presets.glyphs((0.88, 0.84, 0.72), colors[2], frequency=4.0)
            if k != 1
            else presets.checker(colors[3], colors[4])
        )
        b.rect(poster, (x + rng.uniform(-0.4, 0.4), 2.6, -5.47), 1.3, 1.0)
    b.box(presets.stripes(colors[2], (0.9, 0.88, 0.8), frequency=1.0), (0, 5.2, -5.2), (6, 0.35, 0.3))
    spin = turning(b, rng.choice((-1, 1)) * rng.uniform(0.035, 0.05))
    platform = b.new_id()
    disc = presets.dots(presets.shade(colors[3], 0.8), colors[4], frequency=1.6)
    b.rod(disc, (0, 0.12, 0), 3.0, 0.12, rotation("y", spin) @ FLOOR, platform)
    b.rod(
        presets.stripes(colors[4], colors[2], frequency=1.5),
        (0, 1.5, 0),
        0.22,
        1.4,
        rotation("y", spin) @ FLOOR,
        platform,
    )
    count = int(rng.integers(7, 10))
    for k in range(count):
        angle, radius = spin + 2 * np.pi * k / count, rng.uniform(1.6, 2.7)
        size = rng.uniform(0.28, 0.5)
        height = 0.24 + size + 0.25 + swing(b, 0.25, 0.03)
        place = path(radius * np.sin(angle), height, radius * np.cos(angle))
        own = rotation("y", turning(b, rng.uniform(-0.09, 0.09))) @ rotation("x", turning(b, rng.uniform(-0.05, 0.05)))
        material = presets.decorated(rng, colors[rng.integers(5)], colors[rng.integers(5)], detail=1.3)
        shape = k % 4
        thing = b.new_id()
        if shape == 0:
            b.sphere(material, place, size, own, thing)
        elif shape == 1:
            b.box(material, place, (size, size, size), own, thing)
        elif shape == 2:
            b.rod(material, place, size * 0.35, size * 1.5, own, thing)
        else:
            b.box(material, place, (size * 1.3, size * 0.25, size * 0.8), own, thing)
        b.rod(
            presets.metal((0.8, 0.8, 0.82)), place * np.array([1, 0, 1]) + path(0, 1.5, 0), 0.03, 1.4, FLOOR, platform
        )
    b.sun((rng.uniform(-0.6, 0.6), 1.0, rng.uniform(0.4, 0.9)), (5.4, 4.9, 4.2))
    b.lamp((rng.uniform(-2, 2), 4.5, 3.0), (18, 16, 24))
    angle = swing(b, 0.45, 0.03)
    eye = path(7.2 * np.sin(angle), 2.1 + swing(b, 0.3, 0.01), 7.2 * np.cos(angle))
    b.set_camera(eye, path(swing(b, 0.5, 0.04), 1.35, 0.0), focal=rng.uniform(0.85, 1.0))


def gloss(b: Builder) -> None:
    """Build a hall with a polished floor: mirror images that move against the surface they appear on."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.bounces = 1
    b.set_sky(zenith=(0.1, 0.2, 0.5), horizon=(1.3, 0.75, 0.45), clouds=0.62, ambient=0.4,
              sun_direction=(rng.uniform(-0.5, 0.5), 0.25, -1.0), sun_color=(40, 28, 18), sun_size=0.0012)  # fmt: skip
    b.rect(
        presets.tiles((0.16, 0.17, 0.2), (0.05, 0.05, 0.06), frequency=0.9, mirror=0.7, roughness=0.2),
        (0, 0, -4),
        14,
        18,
        FLOOR,
    )
    for side in (-1, 1):
        for k in range(6):
            place = (side * 3.6, 1.9, 2.0 - 3.2 * k)
            b.rod(presets.stone((0.82, 0.8, 0.76), (0.5, 0.46, 0.42)), place, 0.32, 1.9, FLOOR)
            b.box(presets.plaster((0.8, 0.77, 0.7)), (place[0], 3.95, place[2]), (0.45, 0.15, 0.45))
        b.box(presets.plaster((0.75, 0.7, 0.62)), (side * 3.6, 4.3, -6.0), (0.5, 0.2, 10.5))
        b.rect(
            presets.bricks(colors[0], frequency=1.6), (side * 6.5, 1.6, -4), 14, 1.6, rotation("y", -side * np.pi / 2)
        )
    for k in range(4):
        sign = presets.screen(presets.shade(colors[k], 1.4), frequency=2.5, strength=5.0)
        b.box(
            sign, (rng.choice((-1, 1)) * rng.uniform(1.2, 3.0), rng.uniform(1.2, 2.4), -3.5 - 2.6 * k), (0.9, 0.5, 0.05)
        )
    for k in range(7):
        size = rng.uniform(0.3, 0.55)
        orbit = turning(b, rng.uniform(-0.04, 0.04))
        reach = rng.uniform(0.6, 2.2)
        height = size + 0.05 + np.abs(swing(b, 0.8, 0.06)) * (k % 2)
        place = path(reach * np.sin(orbit), height, -3.0 + reach * np.cos(orbit) - 0.9 * k)
        own = rotation("y", turning(b, rng.uniform(-0.08, 0.08)))
        color = colors[k % 5]
        if k % 3 == 0:
            b.sphere(presets.metal(presets.shade(color, 1.4), roughness=0.25), place, size, own)
        elif k % 3 == 1:
            b.box(presets.decorated(rng, color, colors[(k + 2) % 5], detail=1.2), place, (size, size, size), own)
        else:
            b.sphere(presets.checker(color, (0.9, 0.9, 0.86), frequency=2.5), place, size, own)
    b.sun((rng.uniform(-0.5, 0.5), 0.8, 0.5), (5.5, 4.6, 3.6))
    b.lamp((0, 3.4, -4.0), (20, 15, 12))
    eye = path(swing(b, 1.9, rng.uniform(0.16, 0.24)), 1.3 + swing(b, 0.3, 0.02), 4.2 + swing(b, 1.5, 0.08))
    b.set_camera(eye, path(rng.uniform(0.9, 1.3) * eye[:, 0] - 0.3, 1.15, -4.0), focal=rng.uniform(0.85, 1.0))
