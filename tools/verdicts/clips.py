"""Eight clips that are right and unusual, from the built-in renderer, small enough to render in seconds."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from essjax.data import Dataset, write_dataset, write_sequence
from essjax.scenes import Rendering, make_scene, presets, render_sequence
from essjax.scenes.builder import FLOOR, Builder, Scene, rotation
from essjax.scenes.materials import Material

FRAMES, WIDTH, HEIGHT, SPP = 6, 96, 54, 16
DARK = {"zenith": (0, 0, 0), "horizon": (0, 0, 0), "ground": (0, 0, 0), "clouds": 0.0, "ambient": 0.02}
COLORS = presets.PALETTES[0]


def _walk(b: Builder, start, step) -> np.ndarray:
    """``[T, 3]``: evenly from a place."""
    return np.asarray(start, float) + np.arange(b.frames)[:, None] * np.asarray(step, float)


def _turn(b: Builder, axis: str, step: float) -> np.ndarray:
    return rotation(axis, step * np.arange(b.frames))


def _floor(b: Builder) -> None:
    b.rect(presets.checker(COLORS[0], COLORS[4], frequency=0.9), (0, 0, -8), 20, 20, FLOOR)


def fog(b: Builder) -> None:
    """Pale surfaces of hardly any contrast before a white sky, a slow camera, one pale object that moves."""
    b.set_sky(zenith=(0.8, 0.8, 0.82), horizon=(0.8, 0.8, 0.8), ground=(0.7, 0.7, 0.7), clouds=0.0, ambient=0.9)
    pale = lambda k: Material(a=(0.74 + 0.02 * k, 0.75, 0.76), grime=0.06, grime_frequency=2.0)
    b.rect(pale(0), (0, 0, -8), 20, 20, FLOOR)
    for k in range(6):
        b.box(pale(k), (-5 + 2.1 * k, 0.8 + 0.3 * (k % 3), -7.0 - (k % 2)), (0.6, 1.1, 0.5), rotation("y", 0.4 * k))
    b.sphere(pale(2), _walk(b, (-1.0, 0.9, -4.5), (0.12, 0.03, 0.0)), 0.6)
    eye = _walk(b, (-0.3, 1.5, 0.0), (0.09, 0.02, -0.05))
    b.set_camera(eye, eye + (0.0, -0.1, -1.0))


def spin(b: Builder) -> None:
    """Turn the camera by a tenth of the picture and more per frame."""
    _floor(b)
    for k in range(16):
        angle = 2 * np.pi * k / 16
        material = presets.decorated(np.random.default_rng(k), COLORS[k % 5], COLORS[(k + 2) % 5])
        place = (6 * np.sin(angle), 1.0 + 0.5 * (k % 3), -6 * np.cos(angle))
        b.box(material, place, (0.8, 1.4, 0.5), rotation("y", -angle))
    b.sphere(presets.dots(COLORS[1], COLORS[3]), _walk(b, (0.6, 1.3, -3.5), (0.35, 0.05, 0.1)), 0.7)
    b.sun((0.3, 0.8, 0.4), (2.5, 2.4, 2.2))
    angle = 0.13 * np.arange(b.frames)
    eye = np.broadcast_to(np.array([0.0, 1.5, 0.0]), (b.frames, 3))
    b.set_camera(eye, eye + np.stack([np.sin(angle), 0.25 * np.sin(2 * angle), -np.cos(angle)], axis=-1))


def still_camera(b: Builder) -> None:
    """Put a camera on a tripod; one object crosses the picture and one turns in place."""
    _floor(b)
    b.rect(presets.bricks(COLORS[2], frequency=0.9), (0, 3, -10), 14, 3)
    b.box(presets.stripes(COLORS[1], COLORS[4]), _walk(b, (-2.2, 1.0, -5.0), (0.22, 0.08, 0.0)), (0.8, 0.7, 0.6))
    b.box(presets.checker(COLORS[0], COLORS[3]), (1.8, 1.1, -5.5), (0.9, 0.9, 0.9), _turn(b, "y", 0.12))
    b.sun((0.4, 0.8, 0.5), (2.4, 2.3, 2.1))
    b.set_camera((0.2, 1.6, 0.5), (0.1, 1.2, -5.0))


def flat_light(b: Builder) -> None:
    """No shadow and no highlight: all colour is that of the surface, most of it plain, under an even sky."""
    b.set_sky(zenith=(0.6, 0.6, 0.6), horizon=(0.6, 0.6, 0.6), ground=(0.6, 0.6, 0.6), clouds=0.0, ambient=1.0)
    plain = lambda k: Material(a=COLORS[k % 5], grime=0.1, grime_frequency=3.0, roughness=1.0)
    b.rect(plain(4), (0, 0, -8), 20, 20, FLOOR)
    for k in range(7):
        b.box(plain(k), (-5 + 1.8 * k, 0.7, -6.5 + 0.6 * (k % 3)), (0.5, 0.7 + 0.2 * (k % 3), 0.4), rotation("y", k))
    b.box(plain(1), _walk(b, (0.8, 1.2, -4.2), (-0.14, 0.06, 0.0)), (0.5, 0.4, 0.4))
    eye = _walk(b, (0.4, 1.8, 0.3), (-0.1, 0.06, -0.12))
    b.set_camera(eye, eye + (0.05, -0.2, -1.0))


def close_up(b: Builder) -> None:
    """One object that fills nearly all of the picture, tumbling; little else is seen."""
    turn = _turn(b, "y", 0.06) @ _turn(b, "x", 0.035)
    place = _walk(b, (0.1, 1.5, -2.6), (0.02, 0.01, 0))
    b.box(presets.glyphs(COLORS[4], COLORS[1], frequency=2.5), place, (1.5, 0.9, 0.9), turn)
    _floor(b)
    b.sun((0.3, 0.6, 0.8), (2.2, 2.1, 2.0))
    eye = _walk(b, (0.0, 1.6, 0.4), (0.03, 0.02, 0.0))
    b.set_camera(eye, eye + (0.0, -0.05, -1.0))


def night(b: Builder) -> None:
    """Build a dark street: lamps and signs that outshine everything, a black sky, most pixels nearly black."""
    b.set_sky(**DARK)
    b.rect(presets.tiles(presets.shade(COLORS[4], 0.4), (0.03, 0.03, 0.03)), (0, 0, -8), 20, 20, FLOOR)
    for k in range(6):
        side = -1 if k % 2 else 1
        b.box(presets.bricks(presets.shade(COLORS[k % 5], 0.5)), (side * 3.4, 2, -2.5 - 2.4 * k), (0.9, 2, 1.1))
        b.rect(presets.screen(COLORS[(k + 1) % 5], strength=20), (side * 2.45, 1.7, -2.5 - 2.4 * k), 0.8, 0.5,
               rotation("y", -side * np.pi / 2))  # fmt: skip
        b.sphere(presets.lamp((1.0, 0.8, 0.5), 60.0), (side * 1.9, 3.0, -3.4 - 2.4 * k), 0.1)
    b.box(presets.paint(COLORS[0]), _walk(b, (-0.9, 0.5, -4.6), (0.16, 0.0, 0.12)), (0.5, 0.4, 0.8))
    b.lamp((0.0, 3.0, -4.0), (9, 7, 5))
    eye = _walk(b, (0.1, 1.4, 1.0), (0.05, 0.02, -0.18))
    b.set_camera(eye, eye + (0.02, 0.03, -1.0))


def deforming(b: Builder) -> None:
    """Build a cloth that waves in the wind, all its parts in their own way, before plain sky and ground."""
    b.set_sky(clouds=0.0, ambient=0.5)
    b.rect(presets.stone(COLORS[4], COLORS[2]), (0, 0, -8), 20, 20, FLOOR)
    cloth, strips = b.new_id(), 24
    phase = 1.1 * np.arange(b.frames)
    for k in range(strips):
        x = -1.9 + 3.8 * k / (strips - 1)
        wave = 0.42 * np.sin(phase + 2.2 * x)
        slope = np.arctan(0.42 * 2.2 * np.cos(phase + 2.2 * x))
        place = np.stack([x + 0 * wave, 1.9 + 0.12 * wave, -4.6 + wave], axis=-1)
        b.box(presets.checker(COLORS[0], COLORS[3], frequency=5), place, (0.1, 1.0, 0.02), rotation("y", -slope), cloth)
    b.bar(presets.metal((0.6, 0.6, 0.6)), (-2.1, 0, -4.6), (-2.1, 3.2, -4.6), 0.06)
    b.sun((0.2, 0.8, 0.6), (2.4, 2.3, 2.1))
    eye = _walk(b, (0.2, 1.5, 0.6), (-0.07, 0.04, -0.03))
    b.set_camera(eye, eye + (0.0, 0.02, -1.0))


def _made(maker: Callable[[Builder], None]) -> Scene:
    b = Builder(FRAMES, np.random.default_rng(0))
    maker(b)
    return b.build(maker.__name__, 0)


CLIPS: dict[str, Callable[[], Scene]] = {
    "ropes over a mirror": lambda: make_scene("rigging", 2, FRAMES),
    "fog": lambda: _made(fog),
    "fast spin": lambda: _made(spin),
    "still camera": lambda: _made(still_camera),
    "flat light": lambda: _made(flat_light),
    "close-up": lambda: _made(close_up),
    "night with lamps": lambda: _made(night),
    "deforming cloth": lambda: _made(deforming),
}
"""Name -> scene. The constants of the check were chosen while looking at these."""
UNSEEN: dict[str, Callable[[], Scene]] = {
    family: lambda family=family: make_scene(family, 5, FRAMES) for family in ("plaza", "gloss", "carousel", "grille")
}
"""Built-in scenes that nobody looked at for it."""


def render(name: str, folder: Path, *, width: int = WIDTH, height: int = HEIGHT, spp: int = SPP) -> Dataset:
    """Render a clip's dataset as an import would leave it: without the masks that only the renderer knows."""
    sequence = render_sequence((CLIPS | UNSEEN)[name](), width, height, rendering=Rendering(scale=2, spp=spp))
    write_sequence(folder, "clip", dataclasses.replace(sequence, valid=None, steady=None))
    return write_dataset(folder, {"test": ["clip"]})
