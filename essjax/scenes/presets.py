"""Materials and palettes that the families draw from."""

import numpy as np

from essjax.scenes import textures
from essjax.scenes.materials import Material, Rgb

PALETTES: tuple[tuple[Rgb, ...], ...] = (
    ((0.80, 0.33, 0.16), (0.10, 0.28, 0.46), (0.92, 0.74, 0.36), (0.22, 0.47, 0.36), (0.86, 0.83, 0.76)),
    ((0.05, 0.36, 0.55), (0.93, 0.42, 0.33), (0.97, 0.80, 0.48), (0.15, 0.18, 0.35), (0.72, 0.84, 0.84)),
    ((0.52, 0.12, 0.24), (0.88, 0.56, 0.30), (0.18, 0.36, 0.34), (0.94, 0.84, 0.64), (0.32, 0.30, 0.44)),
    ((0.20, 0.50, 0.20), (0.92, 0.88, 0.62), (0.74, 0.22, 0.12), (0.12, 0.26, 0.38), (0.58, 0.66, 0.52)),
    ((0.42, 0.20, 0.55), (0.10, 0.55, 0.58), (0.95, 0.62, 0.20), (0.84, 0.80, 0.86), (0.16, 0.14, 0.28)),
    ((0.90, 0.52, 0.44), (0.30, 0.44, 0.62), (0.94, 0.86, 0.72), (0.44, 0.28, 0.22), (0.50, 0.66, 0.60)),
)
"""Five colours each, linear."""


def palette(rng: np.random.Generator) -> list[Rgb]:
    """One of ``PALETTES`` in random order, more saturated: tone mapping takes some of it away again."""
    colors = np.asarray(PALETTES[rng.integers(len(PALETTES))]) ** 1.5
    return [(float(r), float(g), float(b)) for r, g, b in rng.permutation(colors)]


def shade(color: Rgb, factor: float) -> Rgb:
    """Make a darker (or, up to 1, brighter) colour."""
    r, g, b = (min(1.0, c * factor) for c in color)
    return (r, g, b)


def bricks(color: Rgb, *, frequency: float = 2.2, bump: float = 0.5) -> Material:
    """Bricks in courses, light mortar."""
    return Material(
        a=color, b=(0.55, 0.52, 0.47), pattern=textures.CELLS, frequency=frequency, aspect=2.3, shift=0.5, gap=0.045,
        variation=0.45, grime=0.35, grime_frequency=7.0, bump=bump, roughness=0.85,
    )  # fmt: skip


def tiles(color: Rgb, joint: Rgb, *, frequency: float = 1.2, mirror: float = 0.0, roughness: float = 0.35) -> Material:
    """Square tiles, each of its own shade."""
    return Material(
        a=color, b=joint, pattern=textures.CELLS, frequency=frequency, gap=0.025, variation=0.3, grime=0.15,
        grime_frequency=5.0, bump=0.15, roughness=roughness, roughness_b=0.8, mirror=mirror,
    )  # fmt: skip


def planks(color: Rgb, *, frequency: float = 0.6) -> Material:
    """Long boards with dark gaps."""
    return Material(
        a=color, b=shade(color, 0.2), pattern=textures.CELLS, frequency=frequency, aspect=7.0, shift=0.37, gap=0.02,
        variation=0.35, grime=0.45, grime_frequency=6.0, bump=0.2, roughness=0.55,
    )  # fmt: skip


def plaster(color: Rgb, *, grime: float = 0.25) -> Material:
    """Make a painted wall."""
    return Material(a=color, grime=grime, grime_frequency=3.0, bump=0.12, roughness=0.9)


def stone(color: Rgb, other: Rgb) -> Material:
    """Veined stone."""
    return Material(a=color, b=other, pattern=textures.NOISE, grime=0.35, grime_frequency=4.0, bump=0.25, roughness=0.6)


def checker(a: Rgb, b: Rgb, *, frequency: float = 2.0, roughness: float = 0.45, mirror: float = 0.0) -> Material:
    """Make a chess board."""
    return Material(
        a=a, b=b, pattern=textures.CHECKER, frequency=frequency, grime=0.12, grime_frequency=6.0, roughness=roughness,
        mirror=mirror,
    )  # fmt: skip


def glyphs(paper: Rgb, ink: Rgb, *, frequency: float = 4.0) -> Material:
    """Lines of writing in an unknown script."""
    return Material(a=paper, b=ink, pattern=textures.GLYPHS, frequency=frequency, grime=0.08, roughness=0.8)


def screen(color: Rgb, *, frequency: float = 3.0, strength: float = 8.0) -> Material:
    """Glowing writing on a dark panel: an HDR highlight."""
    return Material(
        a=(0.02, 0.02, 0.03), b=color, pattern=textures.GLYPHS, frequency=frequency, grime=0.0, roughness=0.3,
        emission_b=strength,
    )  # fmt: skip


def lamp(color: Rgb, strength: float = 12.0) -> Material:
    """Make a light source that can be looked at."""
    return Material(a=color, grime=0.0, emission=strength)


def stripes(a: Rgb, b: Rgb, *, frequency: float = 3.0) -> Material:
    """Parallel bands, such as on barriers and awnings."""
    return Material(a=a, b=b, pattern=textures.STRIPES, frequency=frequency, grime=0.15, roughness=0.5)


def dots(a: Rgb, b: Rgb, *, frequency: float = 3.0) -> Material:
    """Discs of random size."""
    return Material(a=a, b=b, pattern=textures.DOTS, frequency=frequency, gap=0.45, grime=0.1, roughness=0.4)


def metal(color: Rgb, *, roughness: float = 0.3, grime: float = 0.15) -> Material:
    """Bare metal."""
    return Material(a=color, grime=grime, grime_frequency=4.0, roughness=roughness, metallic=1.0, bump=0.05)


def paint(color: Rgb, *, roughness: float = 0.3) -> Material:
    """Smooth lacquer with a highlight."""
    return Material(a=color, grime=0.06, roughness=roughness, specular=0.7)


def decorated(rng: np.random.Generator, a: Rgb, b: Rgb, *, detail: float = 1.0) -> Material:
    """Make a random patterned material for an object; ``detail`` scales its frequencies."""
    makers = (
        lambda: checker(a, b, frequency=3.0 * detail),
        lambda: stripes(a, b, frequency=4.0 * detail),
        lambda: dots(a, b, frequency=3.0 * detail),
        lambda: glyphs(a, b, frequency=3.0 * detail),
        lambda: bricks(a, frequency=3.0 * detail),
        lambda: stone(a, b),
        lambda: paint(a),
        lambda: metal(shade(a, 1.3)),
    )
    return makers[rng.integers(len(makers))]()
