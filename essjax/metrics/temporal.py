"""Temporal stability: what flickers between two frames although it should not."""

import jax.numpy as jnp

from essjax.losses import masked_mean, spatio_temporal
from essjax.losses.pixel import as_float32, check_same_shape
from essjax.metrics._psnr import PIXEL_AXES, psnr
from essjax.typing import Image, Mask, Motion, Scalar
from essjax.warp import backward_warp


def flicker(prediction: Image, prediction_previous: Image, target: Image, target_previous: Image) -> Image:
    """Signed change over time that the target lacks, ``[..., H, W, C]``: ``(P_t - P_{t-1}) - (T_t - T_{t-1})``.

    Raises:
      ValueError: the shapes of the frames differ.
    """
    prediction, prediction_previous = as_float32(prediction, prediction_previous, ("prediction", "prediction_previous"))
    target, target_previous = as_float32(target, target_previous, ("target", "target_previous"))
    check_same_shape(prediction, target)
    return (prediction - prediction_previous) - (target - target_previous)


def tpsnr(prediction: Image, prediction_previous: Image, target: Image, target_previous: Image) -> Scalar:
    """PSNR of frame differences in dB ``[...]``, data range 1: how small the ``flicker`` is.

    Args:
      prediction: ``[..., H, W, C]`` display-referred, frame t.
      prediction_previous: the same method's frame t-1.
      target: the reference of frame t.
      target_previous: the reference of frame t-1.

    Raises:
      ValueError: the shapes differ.
    """
    difference = flicker(prediction, prediction_previous, target, target_previous)
    return psnr(difference, jnp.zeros_like(difference))


def spatio_temporal_error(
    prediction: Image,
    prediction_previous: Image,
    target: Image,
    target_previous: Image,
    motion: Motion,
    *,
    theta: float,
) -> Scalar:
    """Mean of ``losses.spatio_temporal`` of each image, ``[...]``: the columns of table 10 of thesis 002 (eq 55).

    With ``theta`` 0 the spatial error (of two frames), with 1 the temporal one.

    Args:
      prediction: ``[..., H, W, C]`` display-referred, frame t.
      prediction_previous: the same method's frame t-1.
      target: the reference of frame t.
      target_previous: the reference of frame t-1.
      motion: ``[..., H, W, 2]`` pixels of this resolution.
      theta: share of the temporal term, in [0, 1].

    Raises:
      ValueError: the shapes differ, or ``theta`` is outside [0, 1].
    """
    prediction, target = as_float32(prediction, target)
    prediction_previous, target_previous = as_float32(
        prediction_previous, target_previous, ("prediction_previous", "target_previous")
    )
    previous = backward_warp(prediction_previous - target_previous, motion)
    return jnp.mean(spatio_temporal(prediction - target, previous, theta=theta), axis=PIXEL_AXES)


def warped_error(image: Image, image_previous: Image, motion: Motion, *, valid: Mask | None = None) -> Scalar:
    """Mean ``|I_t - warp(I_{t-1})|`` of each image, ``[...]``: what changes although the surface is the same.

    Moving shadows and mirror images change in the reference as well: compare a method's value with the reference's.

    Args:
      image: ``[..., H, W, C]`` display-referred, frame t.
      image_previous: frame t-1.
      motion: ``[..., H, W, 2]`` pixels of this resolution; with the jitter difference where both frames are jittered.
      valid: ``[..., H, W, 1]``, 1 where the previous frame shows the same surface; all pixels if None. NaN where empty.

    Raises:
      ValueError: the shapes differ.
    """
    image, image_previous = as_float32(image, image_previous, ("image", "image_previous"))
    error = jnp.abs(image - backward_warp(image_previous, motion))
    if valid is None:
        return jnp.mean(error, axis=PIXEL_AXES)
    return jnp.where(jnp.sum(valid, axis=PIXEL_AXES) > 0, masked_mean(error, valid, axis=PIXEL_AXES), jnp.nan)
