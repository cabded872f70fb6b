"""A flat painted wall in front of a resting camera: smooth paint with a hard edge, under light that may move."""

import jax
import jax.numpy as jnp
import numpy as np

from essjax.frames import Frame, GBuffers, Sequence
from essjax.scenes.jitter import jitter_sequence


def _paint(x, y):
    """Base colour in [0, 1] at positions in LR pixels."""
    waves = 0.3 + 0.2 * np.sin(0.7 * x + 0.3 * y + np.array([0.0, 1.0, 2.5])[:, None, None])
    stripe = np.where(0.8 * x + 0.5 * y > 11.3, 0.4, 0.0)
    return np.moveaxis(waves, 0, -1) + stripe[..., None]


def _light(x, y, shift):
    """Light that has moved by ``shift`` LR pixels to the right."""
    return (1.5 + 0.8 * np.sin(0.5 * (x - shift)) * np.cos(0.4 * y))[..., None]


def wall(T: int, B: int, H: int, W: int, *, light_speed: float = 0.0, samples: int = 6) -> Sequence:
    """Frames ``[T, B, H, W, ...]`` with jitter and no motion, and the box-filtered reference at twice the size.

    Batch elements see the wall 5.5 pixels apart. The light moves ``light_speed`` LR pixels per frame.
    """
    jitter = jitter_sequence(T)
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    steps = (np.arange(samples) + 0.5) / samples
    color, paint, reference = [], [], []
    for t in range(T):
        for b in range(B):
            here = x + jitter[t, 0] + 5.5 * b, y + jitter[t, 1]
            paint.append(_paint(*here))
            color.append(paint[-1] * _light(*here, light_speed * t))
            total = 0.0
            for dy in steps:
                for dx in steps:
                    fine = np.meshgrid((np.arange(2 * W) + dx) / 2 + 5.5 * b, (np.arange(2 * H) + dy) / 2)
                    total = total + _paint(*fine) * _light(*fine, light_speed * t)
            reference.append(total / samples**2)

    def stacked(images):
        images = np.asarray(images, np.float32)
        return images.reshape(T, B, *images.shape[1:])

    lead = (T, B, H, W)
    frames = Frame(
        color=stacked(color),
        gbuffers=GBuffers(
            base_color=stacked(paint),
            normal=np.broadcast_to(np.array([0, 0, 1], np.float32), (*lead, 3)),
            depth=np.full((*lead, 1), 5.0, np.float32),
        ),
        motion=np.zeros((*lead, 2), np.float32),
        jitter=np.broadcast_to(np.asarray(jitter, np.float32)[:, None], (T, B, 2)),
        cut=np.broadcast_to((np.arange(T) == 0)[:, None], (T, B)),
        exposure=np.ones((T, B), np.float32),
    )
    return jax.tree.map(jnp.asarray, Sequence(frames=frames, reference=stacked(reference)))
