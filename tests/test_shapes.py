"""Annotations of shapes are true: public functions are traced under jaxtyping's checks (docs/adr/0002)."""

import functools
import inspect

import beartype
import jax
import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError, jaxtyped

from essjax import color, losses, metrics, warp
from essjax.frames import GBuffers

LEAD, H, W = (2, 3), 9, 11
LARGE = {"height": 2 * H, "width": 2 * W}


def array(*last, height=H, width=W, dtype=jnp.float32):
    return jax.ShapeDtypeStruct((*LEAD, height, width, *last), dtype)


def flat(*last, dtype=jnp.float32):
    return jax.ShapeDtypeStruct((*LEAD, *last), dtype)


IMAGE, PLANE, COLOR, FIELD, GUIDE = array(4), array(1), array(3), array(2), array(6)
SIZE = (LARGE["height"], LARGE["width"])
LARGE_FIELD, JITTER, CLASSES = array(2, **LARGE), flat(2), array(1, dtype=jnp.int32)
BOTH = {"jitter": JITTER, "jitter_previous": JITTER}
GBUFFERS = GBuffers(depth=PLANE, normal=COLOR, world_position=COLOR)
LEVELS = [array(4), array(8, height=3, width=4)]
POINTWISE = (
    "log1p", "expm1", "reinhard", "reinhard_inverse", "log1p_of_reinhard", "srgb_encode", "srgb_decode", "display",
    "display_of_log1p",
)  # fmt: skip
CALLS = {
    color.demodulation_albedo: (COLOR, array(1, dtype=bool), PLANE, PLANE),
    color.demodulate: (COLOR, COLOR), color.modulate: (COLOR, COLOR), color.expose: (IMAGE, flat()),
    **{getattr(color, name): (IMAGE,) for name in POINTWISE},
    color.display_inverse: (COLOR,), color.rgb_to_ycocg: (COLOR,), color.ycocg_to_rgb: (COLOR,),
    color.sum_channels: (IMAGE,), color.luminance: (COLOR,),
    losses.census: (COLOR, COLOR), losses.feature_census: (IMAGE, IMAGE), losses.charbonnier: (IMAGE, IMAGE),
    losses.class_weights: (CLASSES, {"count": 3}, PLANE), losses.cross_entropy: (IMAGE, CLASSES),
    losses.feature_l1: (LEVELS, LEVELS), losses.hardest: (IMAGE,), losses.l1: (IMAGE, IMAGE),
    losses.masked_mean: (IMAGE, PLANE), losses.occlusion: (COLOR, COLOR, PLANE),
    losses.perceptual: (COLOR, COLOR, {"features": lambda x: [x, x[..., ::2, ::2, :2]]}),
    losses.spatio_temporal: (IMAGE, IMAGE, {"theta": 0.5}), losses.ssim_map: (COLOR, COLOR, {"window": 3}),
    losses.sum_of_means: (LEVELS,), losses.temporal_l1: (COLOR, COLOR, PLANE),
    metrics.flicker: (IMAGE,) * 4, metrics.psnr: (IMAGE, IMAGE, {"mask": PLANE}),
    metrics.spatio_temporal_error: (*(IMAGE,) * 4, FIELD, {"theta": 0.5}),
    metrics.ssim: (IMAGE, IMAGE, {"mask": PLANE, "window": 3}), metrics.tpsnr: (IMAGE,) * 4,
    metrics.warped_error: (IMAGE, IMAGE, FIELD, {"valid": PLANE}),
    warp.backward_warp: (IMAGE, FIELD), warp.compose_motion: (FIELD, FIELD, BOTH),
    warp.depth_to_space: (IMAGE, {"block": 2}), warp.dilate_motion: (IMAGE, PLANE), warp.fill_holes: (IMAGE, PLANE),
    warp.gaussian_resample: (IMAGE, COLOR, JITTER, jax.ShapeDtypeStruct((), jnp.float32), {"size": SIZE}),
    warp.gbuffer_guided_warp: (COLOR, GUIDE, GUIDE, FIELD), warp.guided_weights: (GUIDE, GUIDE, FIELD),
    warp.guides: (GBuffers(depth=PLANE, base_color=COLOR, normal=COLOR),),
    warp.hole_mask: (GBUFFERS, GBUFFERS, FIELD, BOTH), warp.inside_mask: (FIELD,),
    warp.depth_guide: (PLANE,), warp.normals_from_depth: (PLANE,),
    warp.jitter_aligned_upsample: (IMAGE, {"size": SIZE}, JITTER),
    warp.jittered_motion: (FIELD, JITTER, JITTER), warp.occlusion_motion: (FIELD, PLANE, PLANE),
    warp.sample: (IMAGE, LARGE_FIELD), warp.sample_by_fetches: (IMAGE, LARGE_FIELD),
    warp.sample_zero_upsampled: (IMAGE, LARGE_FIELD, {"size": SIZE}, JITTER),
    warp.space_to_depth: (array(4, **LARGE), {"block": 2}), warp.splat: (IMAGE, FIELD),
    warp.splat_motion: (IMAGE, PLANE, FIELD), warp.splat_nearest: (IMAGE, PLANE, FIELD),
    warp.tent_resample: (IMAGE, COLOR, JITTER, {"size": SIZE}), warp.upsample_motion: (FIELD, {"size": SIZE}),
    warp.to_half_grid: (IMAGE, {"size": SIZE}, JITTER), warp.half_grid_offset: ({"low": (6, 8), "size": SIZE}, JITTER),
    warp.nearest_upsample: (IMAGE, {"size": SIZE}), warp.zero_upsample: (IMAGE, {"size": SIZE}, JITTER),
}  # fmt: skip
"""Function -> its arguments: arrays in order, others by name."""
WITHOUT_ARRAYS = {
    "aggregate",
    "candidate_offsets",
    "distances",
    "half_size",
    "has_source",
    "mean_over",
    "score_rollout",
    "vgg16_features",
}


def checked(function):
    """``function``, or what a ``jax.custom_vjp`` is of, with every argument and result checked; ints are floats."""
    checker = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
    return jaxtyped(typechecker=checker)(getattr(function, "fun", function))


def traced(function, arguments):
    """The shapes of the result, each argument given by name."""
    by_name = {name: value for argument in arguments if isinstance(argument, dict) for name, value in argument.items()}
    names = (name for name in inspect.signature(function).parameters if name not in by_name)
    in_order = (argument for argument in arguments if not isinstance(argument, dict))
    static = {name: value for name, value in by_name.items() if not isinstance(value, jax.ShapeDtypeStruct)}
    given = {**by_name, **dict(zip(names, in_order, strict=False))}
    given = {name: value for name, value in given.items() if name not in static}
    return jax.eval_shape(functools.partial(checked(function), **static), **given)


@pytest.mark.parametrize("function", CALLS, ids=lambda function: function.__name__)
def test_annotations_are_true(function):
    traced(function, CALLS[function])


def test_every_public_function_is_called():
    for module in (losses, metrics, warp):
        functions = {name: getattr(module, name) for name in module.__all__}
        missing = {n for n, f in functions.items() if callable(f) and not inspect.isclass(f) and f not in CALLS}
        assert missing <= WITHOUT_ARRAYS
    own = {n for n, f in vars(color).items() if getattr(f, "__module__", "") == color.__name__ and n[0] != "_"}
    assert {getattr(color, name) for name in own} <= set(CALLS)


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (warp.backward_warp, (IMAGE, array(3))),
        (warp.gbuffer_guided_warp, (COLOR, GUIDE, array(6, height=H + 1), FIELD)),
        (warp.splat_nearest, (IMAGE, COLOR, FIELD)),
        (losses.occlusion, (COLOR, COLOR, COLOR)),
        (metrics.psnr, (IMAGE, COLOR)),
        (color.luminance, (IMAGE,)),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_wrong_shapes_are_seen(function, arguments):
    with pytest.raises(TypeCheckError):
        traced(function, arguments)
