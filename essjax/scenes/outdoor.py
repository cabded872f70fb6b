"""Families under the sky: grille, shadows, texture, and the test-only plaza and cuts."""

import numpy as np

from essjax.scenes import presets
from essjax.scenes.builder import FLOOR, Builder, look_at, rotation
from essjax.scenes.indoor import path, swing, turning


def grille(b: Builder) -> None:
    """Fences, cables and lattices in front of walls and sky: geometry thinner than a pixel."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.set_sky(clouds=0.62, ambient=0.55, sun_direction=(-0.6, 0.5, -0.8), sun_color=(36, 32, 26))
    b.rect(presets.tiles(presets.shade(colors[0], 0.8), (0.15, 0.14, 0.13), frequency=1.1), (0, 0, 0), 20, 20, FLOOR)
    b.box(presets.bricks(colors[1], frequency=1.5), (-3.5, 1.6, -7), (3.2, 1.6, 0.4))
    b.box(presets.plaster(colors[2]), (3.6, 2.2, -8), (2.6, 2.2, 0.6))
    b.rect(presets.glyphs((0.9, 0.86, 0.76), (0.1, 0.08, 0.2), frequency=3.0), (3.4, 2.4, -7.35), 1.7, 1.0)
    b.rect(presets.checker(colors[3], (0.9, 0.9, 0.85), frequency=2.4), (-3.6, 1.8, -6.55), 1.5, 0.9)
    steel, dark = presets.metal((0.7, 0.72, 0.75), roughness=0.4), presets.paint(presets.shade(colors[4], 0.6))
    for k in range(21):
        b.bar(dark, (-3.0 + 0.3 * k, 0.0, 0.6), (-3.0 + 0.3 * k, 1.7, 0.6), 0.022)
    for y in (0.25, 1.55):
        b.bar(dark, (-3.3, y, 0.6), (3.3, y, 0.6), 0.03)
    for k in range(12):
        x = -3.4 + 0.62 * k
        b.bar(steel, (x, 0.0, -3.0), (x + 1.1, 2.6, -3.0), 0.018)
        b.bar(steel, (x + 1.1, 0.0, -3.05), (x, 2.6, -3.05), 0.018)
    for k in range(3):
        b.bar(presets.paint((0.05, 0.05, 0.06)), (-8, 3.2 + 0.35 * k, -4 + k), (8, 3.5 + 0.2 * k, -6 + k), 0.02)
    gate, wing = rotation("y", swing(b, 0.9, 0.05)), b.new_id()
    hinge = np.array([-0.4, 0.0, -1.2])
    for k in range(6):
        post = np.array([0.25 + 0.28 * k, 0.8, 0.0])
        b.rod(presets.paint(colors[2]), hinge + gate @ post, 0.025, 0.75, gate @ FLOOR, wing)
    for y in (0.2, 1.45):
        rail = np.array([0.95, y, 0.0])
        b.rod(presets.paint(colors[2]), hinge + gate @ rail, 0.03, 0.8, gate @ rotation("y", np.pi / 2), wing)
    for k in range(4):
        size = rng.uniform(0.3, 0.6)
        run = path(swing(b, 3.0, rng.uniform(0.06, 0.12)), size, -4.4 - 0.5 * k)
        b.sphere(
            presets.decorated(rng, colors[k], colors[k - 1], detail=1.2), run, size, rotation("z", turning(b, 0.12))
        )
    b.sun((-0.5, 0.9, 0.35), (6.0, 5.5, 4.6))
    eye = path(swing(b, 2.0, rng.uniform(0.18, 0.24)), 1.25 + swing(b, 0.2, 0.02), 3.6 + swing(b, 0.5, 0.04))
    b.set_camera(eye, path(rng.uniform(1.0, 1.3) * eye[:, 0] + 0.4, 1.3, -3.0), focal=rng.uniform(0.8, 0.95))


def shadows(b: Builder) -> None:
    """Build a courtyard under a racing sun and a flying lamp: hard shadows that sweep over static geometry."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.set_sky(zenith=(0.2, 0.3, 0.6), horizon=(0.9, 0.75, 0.6), ambient=0.35, clouds=0.6)
    b.rect(
        presets.tiles(presets.shade(colors[0], 0.9), (0.2, 0.18, 0.16), frequency=1.0, roughness=0.6),
        (0, 0, 0),
        16,
        16,
        FLOOR,
    )
    b.rect(presets.bricks(colors[1], frequency=1.4), (0, 2.2, -6), 12, 2.2)
    b.rect(presets.plaster(colors[2]), (-6.5, 2.0, -1), 8, 2.0, rotation("y", np.pi / 2))
    for k in range(9):
        size, tall = rng.uniform(0.3, 0.6), rng.uniform(0.5, 1.6)
        spot = (-4.0 + 1.1 * k + rng.uniform(-0.3, 0.3), tall, rng.uniform(-4.5, 0.8))
        b.box(
            presets.decorated(rng, colors[k % 5], colors[(k + 3) % 5]),
            spot,
            (size, tall, size),
            rotation("y", rng.uniform(0, 3)),
        )
    for _ in range(10):
        x, z = rng.uniform(-4.5, 4.5), rng.uniform(-4.0, 1.2)
        b.bar(presets.metal((0.75, 0.7, 0.6)), (x, 0, z), (x + rng.uniform(-0.5, 0.5), rng.uniform(1.5, 3.2), z), 0.05)
    for _ in range(5):
        size = rng.uniform(0.3, 0.5)
        b.sphere(presets.paint(colors[rng.integers(5)]), (rng.uniform(-3.5, 3.5), size, rng.uniform(-3, 1.5)), size)
    for k in range(8):
        b.box(presets.planks(presets.shade(colors[3], 0.7)), (-3.5 + k, 3.4, -1.0), (0.09, 0.09, 3.0))
    day = swing(b, 0.9, rng.uniform(0.02, 0.035))
    b.sun(path(np.sin(day) + 0.2, 0.9, 0.55 + 0.3 * np.cos(day)), (6.5, 5.6, 4.4))
    fly = turning(b, rng.uniform(0.05, 0.08))
    place = path(2.6 * np.sin(fly), 2.4 + 0.4 * np.sin(2.3 * fly), -1.2 + 2.2 * np.cos(fly))
    b.lamp(place, (14, 19, 30))
    b.sphere(presets.lamp((0.6, 0.8, 1.0), 25.0), place + path(0, 0.13, 0), 0.1)
    angle = swing(b, 0.35, 0.018)
    eye = path(6.8 * np.sin(angle), 2.4 + swing(b, 0.3, 0.01), 6.6 * np.cos(angle))
    b.set_camera(eye, path(rng.uniform(0.8, 1.1) * eye[:, 0], 1.1, -1.0), focal=rng.uniform(0.85, 1.0))


def texture(b: Builder) -> None:
    """Panels of brick, script, checks and noise seen close, from the side and far away."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.set_sky(clouds=0.6, ambient=0.5)
    floor = presets.checker if rng.random() < 0.5 else presets.tiles
    b.rect(floor(colors[0], presets.shade(colors[4], 0.5), frequency=2.5), (0, 0, -4), 16, 16, FLOOR)
    b.rect(presets.bricks(colors[1], frequency=2.6), (0, 2.5, -7), 14, 2.5)
    makers = (
        lambda: presets.glyphs((0.9, 0.87, 0.78), (0.08, 0.06, 0.08), frequency=7.0),
        lambda: presets.bricks(colors[2], frequency=3.5),
        lambda: presets.checker(colors[3], (0.92, 0.9, 0.86), frequency=5.0),
        lambda: presets.stone(colors[4], presets.shade(colors[1], 0.5)),
        lambda: presets.stripes(colors[0], (0.9, 0.88, 0.8), frequency=6.0),
        lambda: presets.dots(colors[3], colors[2], frequency=5.0),
        lambda: presets.planks(colors[2], frequency=1.0),
        lambda: presets.glyphs(presets.shade(colors[0], 0.4), colors[2], frequency=5.0),
    )
    for k in range(14):
        wide, tall = rng.uniform(0.6, 1.0), rng.uniform(0.7, 1.2)
        spot = (-6.0 + 0.95 * k + rng.uniform(-0.2, 0.2), tall, rng.uniform(-5.5, -0.8))
        b.box(makers[k % 8](), spot, (wide, tall, 0.08), rotation("y", rng.uniform(-1.0, 1.0)))
    for k in range(4):
        size = rng.uniform(0.35, 0.6)
        place = path(-3 + 2 * k + swing(b, 0.8, 0.05), size + 0.1 + np.abs(swing(b, 0.5, 0.03)), 0.3 - 0.2 * k)
        b.sphere(makers[(k + 3) % 8](), place, size, rotation("y", turning(b, rng.uniform(-0.06, 0.06))))
    b.sun((rng.uniform(-0.7, 0.7), 1.0, 0.8), (6.0, 5.5, 4.8))
    eye = path(swing(b, 3.0, rng.uniform(0.16, 0.22)), 1.3 + swing(b, 0.25, 0.02), 3.2 + swing(b, 0.8, 0.05))
    b.set_camera(eye, path(rng.uniform(1.0, 1.3) * eye[:, 0] - 0.5, 1.15, -3.0), focal=rng.uniform(0.85, 1.0))


def _square(b: Builder, colors) -> None:
    """Build what plaza and cuts share: a paved square with houses, signs, lamps, a fence and moving things."""
    rng = b.rng
    b.rect(presets.tiles(presets.shade(colors[0], 0.85), (0.2, 0.18, 0.17), frequency=0.8), (0, 0, 0), 30, 30, FLOOR)
    for k in range(9):
        angle = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / 9
        wide, tall = rng.uniform(1.2, 2.2), rng.uniform(1.6, 3.6)
        reach = rng.uniform(9.0, 12.0)
        turn = rotation("y", angle + rng.uniform(-0.2, 0.2))
        place = np.array([reach * np.sin(angle), tall, reach * np.cos(angle)])
        wall = presets.bricks(colors[k % 5], frequency=1.2) if k % 2 else presets.plaster(colors[k % 5])
        b.box(wall, place, (wide, tall, 1.0), turn)
        face = place + turn @ np.array([0, 0.1 * tall, -1.03])
        sign = presets.screen(presets.shade(colors[(k + 2) % 5], 1.5), frequency=2.0, strength=10.0)
        b.rect(
            sign if k % 3 else presets.glyphs((0.9, 0.86, 0.78), (0.1, 0.1, 0.1), frequency=2.5),
            face,
            0.8 * wide,
            0.45,
            turn,
        )
    for k in range(6):
        angle = 2 * np.pi * k / 6 + 0.4
        spot = np.array([4.4 * np.sin(angle), 0.0, 4.4 * np.cos(angle)])
        b.bar(presets.paint((0.06, 0.07, 0.08)), spot, spot + (0, 2.6, 0), 0.05)
        b.sphere(presets.lamp((1.0, 0.85, 0.6), 14.0), spot + (0, 2.7, 0), 0.16)
    for k in range(16):
        b.bar(presets.metal((0.7, 0.7, 0.72)), (-2.2 + 0.29 * k, 0.0, -3.4), (-2.2 + 0.29 * k, 1.0, -3.4), 0.02)
    b.bar(presets.metal((0.7, 0.7, 0.72)), (-2.3, 1.0, -3.4), (2.3, 1.0, -3.4), 0.03)
    for k in range(5):
        size = rng.uniform(0.3, 0.55)
        orbit = turning(b, rng.choice((-1, 1)) * rng.uniform(0.03, 0.05))
        place = path(
            (1.2 + 0.5 * k) * np.sin(orbit), size + 0.3 * np.abs(swing(b, 1.0, 0.08)), (1.2 + 0.5 * k) * np.cos(orbit)
        )
        own = rotation("y", turning(b, 0.07)) @ rotation("x", turning(b, 0.04))
        thing = (
            presets.metal(presets.shade(colors[k], 1.5), roughness=0.22)
            if k % 2
            else presets.decorated(rng, colors[k], colors[k - 1])
        )
        if k % 3 == 2:
            b.box(thing, place, (size, size, size), own)
        else:
            b.sphere(thing, place, size, own)


def plaza(b: Builder) -> None:
    """Build a square in the evening sun: glowing signs, lamps, metal, a pool that mirrors the sky, far above white."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.bounces = 1
    sun = (rng.uniform(-0.4, 0.4), 0.32, -1.0)
    b.set_sky(zenith=(0.12, 0.25, 0.6), horizon=(1.1, 0.75, 0.5), clouds=0.66, ambient=0.45, sun_direction=sun,
              sun_color=(120, 80, 45), sun_size=0.0008)  # fmt: skip
    _square(b, colors)
    b.box(
        presets.tiles((0.05, 0.09, 0.1), (0.03, 0.05, 0.06), frequency=1.5, mirror=0.9, roughness=0.15),
        (0, 0.03, 2.6),
        (2.6, 0.03, 1.3),
    )
    b.sun(sun, (8.0, 5.4, 3.4))
    angle = swing(b, 0.5, rng.uniform(0.04, 0.055))
    height = 1.7 + swing(b, 0.3, 0.012)
    eye = path(7.2 * np.sin(angle), height, 7.2 * np.cos(angle) + swing(b, 0.8, 0.04))
    # The houses begin at 7.5 m: no further out, or the camera stands inside one.
    eye[:, ::2] *= np.minimum(1.0, 7.3 / np.hypot(eye[:, 0], eye[:, 2]))[:, None]
    b.set_camera(eye, path(0.7 * eye[:, 0], 1.6, -2.0), focal=rng.uniform(0.75, 0.9))


def cuts(b: Builder) -> None:
    """Build the same kind of square at noon, seen by four cameras in turn: history ends at every cut."""
    rng, colors = b.rng, presets.palette(b.rng)
    b.set_sky(clouds=0.68, ambient=0.6, sun_direction=(0.5, 0.7, 0.4), sun_color=(60, 56, 48))
    _square(b, colors)
    b.sun((0.5, 0.9, 0.4), (6.0, 5.6, 5.0))
    shots = []
    for k in range(4):
        angle = rng.uniform(0, 2 * np.pi) + (1 if k % 2 else -1) * rng.uniform(0.03, 0.045) * b.time
        reach, height = rng.uniform(4.0, 7.0), rng.uniform(0.8, 3.0)
        eye = path(reach * np.sin(angle), height, reach * np.cos(angle))
        target = path(swing(b, 0.8, 0.03), rng.uniform(0.8, 1.8), swing(b, 0.8, 0.03))
        shots.append(look_at(eye, target))
    b.focal = np.full(b.frames, rng.uniform(0.8, 0.95))
    length, shot, left = b.frames, 0, int(rng.integers(3, 6))  # so early that short clips have a cut, too
    chosen = np.zeros(length, int)
    for n in range(length):
        if left == 0:
            shot, left = shot + 1, int(rng.integers(10, 17))
            b.cut[n] = True
        chosen[n], left = shot % len(shots), left - 1
    b.camera = np.stack(shots)[chosen, np.arange(length)]
