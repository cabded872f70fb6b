"""Warps of one low-resolution image, as the methods call them."""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp

from essjax.cameras import pixel_positions
from essjax.warp import (
    backward_warp,
    dilate_motion,
    fill_holes,
    gaussian_resample,
    gbuffer_guided_warp,
    guides,
    hole_mask,
    occlusion_motion,
    sample_by_fetches,
    splat,
    splat_nearest,
    upsample_motion,
)
from experiments.benchmark import inputs, peers
from experiments.benchmark.measure import Case, measure
from experiments.benchmark.suites import Options, Row


def cases(width: int, height: int) -> list[Case]:
    """Every warp on images ``[H, W, 3]``; the guided one on the guides of ``essjax.warp.guides`` (6 channels)."""
    now, before = (jax.tree.map(lambda leaf: leaf[0], inputs.frame(width, height, seed)) for seed in (0, 100))
    image, motion, depth = before.color, now.motion, now.gbuffers.depth
    size = f"{width}x{height}"
    hole = (inputs.waves(width, height, 1, 7) > 0.3).astype("float32")
    guide_pair = guides(before.gbuffers), guides(now.gbuffers)
    positions = pixel_positions(height, width) + motion

    def gradient(mode):
        return lambda image, motion: jax.grad(lambda x: jnp.sum(backward_warp(x, motion, mode=mode) ** 2))(image)

    made = [
        ("bilinear", backward_warp, (image, motion)),
        ("bicubic (a = -0.5)", partial(backward_warp, mode="bicubic"), (image, motion)),
        ("bicubic (a = -0.75)", partial(backward_warp, mode="bicubic-0.75"), (image, motion)),
        ("bicubic of 9 fetches", sample_by_fetches, (image, positions)),
        ("bicubic of 5 fetches", partial(sample_by_fetches, fetches=5), (image, positions)),
        ("gradient of bilinear", gradient("bilinear"), (image, motion)),
        ("gradient of bicubic", gradient("bicubic"), (image, motion)),
        ("splat", splat, (image, motion)),
        ("splat of the nearest depth", splat_nearest, (image, depth, motion)),
        ("guided", gbuffer_guided_warp, (image, *guide_pair, motion)),
        ("occlusion motion", occlusion_motion, (motion, depth, hole)),
        ("dilated motion", dilate_motion, (motion, depth)),
        ("motion at twice the size", partial(upsample_motion, size=(2 * height, 2 * width)), (motion,)),
        ("hole mask", hole_mask, (now.gbuffers, before.gbuffers, motion)),
        ("fill holes", fill_holes, (image, hole)),
        ("Gaussian resampling to twice the size", _resample, (image, now.jitter)),
    ]
    return [Case(f"{name}, {size}", function, args, work={"pixels": width * height}) for name, function, args in made]


def _resample(image, jitter):
    return gaussian_resample(image, image, jitter, jnp.float32(0.65), (2 * image.shape[-3], 2 * image.shape[-2]))


def rows(options: Options) -> Iterator[Row]:
    """Ours, then the peers of each case."""
    for case in cases(options.width, options.height):
        if not options.wanted(case.name):
            continue
        yield measure(case, options.repetitions)
        if options.peers:
            yield from peers.rows(case, options.repetitions)
