"""Small random inputs that hold every convention, for tests of any part."""

import jax
import jax.numpy as jnp
import numpy as np

from essjax.cameras import Camera
from essjax.frames import Frame, GBuffers, SampleRanges, Sequence, select_time
from essjax.rollout import stream

at = jax.jit(select_time)  # one program per shape of frames; by slices, each frame and leaf would be one


def streamed(method, variables, frames: Frame, kinds, **options) -> jax.Array:
    """Images ``[T, ...]`` of ``rollout.stream`` over frames ``[T, ...]``."""
    each = (at(frames, n) for n in range(frames.motion.shape[0]))
    return jnp.stack(list(stream(method, variables, each, kinds, **options)))


def indices_of(kinds: tuple[str, ...], kind: str) -> list[int]:
    """Of the frames of one kind."""
    return [n for n, each in enumerate(kinds) if each == kind]


def random_image(seed: int, *shape: int, low: float = 0.0, high: float = 2.0) -> jax.Array:
    """Uniform noise in [low, high), float32."""
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, shape), jnp.float32)


def random_camera(seed: int, T: int, B: int, H: int, W: int) -> Camera:
    """Cameras that walk and turn a little from frame to frame; focal length about the image's width."""
    rng = np.random.default_rng(seed)
    matrix = np.tile(np.eye(4), (T, B, 1, 1))
    yaw = np.cumsum(rng.normal(0.0, 0.01, (T, B)), axis=0)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    matrix[..., 0, 0], matrix[..., 0, 2], matrix[..., 2, 0], matrix[..., 2, 2] = cosine, sine, -sine, cosine
    matrix[..., :3, 3] = np.cumsum(rng.normal(0.0, 0.05, (T, B, 3)), axis=0)
    return Camera(
        camera_to_world=jnp.asarray(matrix, jnp.float32),
        focal=jnp.full((T, B, 2), 0.9 * W, jnp.float32),
        center=jnp.broadcast_to(jnp.array([W / 2, H / 2], jnp.float32), (T, B, 2)),
    )


def make_frames(
    seed: int = 0, T: int = 5, B: int = 2, H: int = 12, W: int = 18, *, motion_range: float = 1.5, sky: float = 0.1
) -> Frame:
    """Random frames ``[T, B, H, W, ...]`` with every buffer, that pass ``validate_frame``; only frame 0 is a cut.

    Nothing in them belongs together (colour is noise, motion is noise in +-``motion_range`` pixels): they test plumbing
    and pointwise laws, not quality. A share ``sky`` of the pixels is background. The jitter changes every second frame.
    """
    rng = np.random.default_rng(seed)

    def noise(channels: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
        return rng.uniform(low, high, (T, B, H, W, channels)).astype(np.float32)

    hit = noise(1) >= sky
    normal = rng.normal(size=(T, B, H, W, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    gbuffers = GBuffers(
        base_color=noise(3) * hit,
        normal=normal * hit,
        depth=np.where(hit, noise(1, 1.0, 20.0), np.inf).astype(np.float32),
        roughness=noise(1) * hit,
        metallic=noise(1) * hit,
        specular=np.full((T, B, H, W, 1), 0.5, np.float32),
        world_position=noise(3, -5.0, 5.0) * hit,
        stencil=rng.integers(0, 3, (T, B, H, W, 1)).astype(np.int32) * hit,
        n_dot_v=noise(1) * hit,
    )
    jitter = rng.uniform(-0.5, 0.499, ((T + 1) // 2, B, 2)).astype(np.float32)
    frames = Frame(
        color=noise(3, 0.0, 2.0),
        gbuffers=gbuffers,
        motion=noise(2, -motion_range, motion_range),
        jitter=np.repeat(jitter, 2, axis=0)[:T],
        cut=np.broadcast_to((np.arange(T) == 0)[:, None], (T, B)),
        exposure=np.ones((T, B), np.float32),
        camera=random_camera(seed, T, B, H, W),
    )
    return jax.tree.map(jnp.asarray, frames)


def make_ranges(seed: int, *shape: int, motion_range: float = 3.0, sky: float = 0.1) -> SampleRanges:
    """Random ranges ``[*shape, C]``; a share ``sky`` of the pixels sees background, half of them with other samples."""
    rng = np.random.default_rng(seed)
    near, far = np.sort(rng.uniform(1.0, 20.0, (2, *shape, 1)), axis=0)
    low, high = np.sort(rng.uniform(0.0, 2.0, (2, *shape, 3)), axis=0)
    chance = rng.uniform(size=(*shape, 1))
    smooth, bumps = rng.uniform(0.0, 1.0, (2, *shape, 1))
    ranges = SampleRanges(
        depth_min=np.where(chance < sky / 2, np.inf, near),
        depth_max=np.where(chance < sky, np.inf, far),
        color_min=low,
        color_max=high,
        normal_spread=smooth + bumps,
        normal_spread_smooth=smooth,
        motion=rng.uniform(-motion_range, motion_range, (*shape, 2)),
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), ranges)


def make_sequence(
    seed: int = 0,
    T: int = 5,
    B: int = 2,
    H: int = 12,
    W: int = 18,
    *,
    scale: int = 2,
    native: bool = False,
    ranges: bool = False,
) -> Sequence:
    """``make_frames`` with a random reference and mask, and native frames and ranges on request."""
    rng = np.random.default_rng(seed + 1000)
    return Sequence(
        frames=make_frames(seed, T, B, H, W),
        reference=jnp.asarray(rng.uniform(0.0, 2.0, (T, B, scale * H, scale * W, 3)), jnp.float32),
        valid=jnp.asarray(rng.uniform(size=(T, B, H, W, 1)) < 0.8, jnp.float32),
        native=make_frames(seed + 1, T, B, scale * H, scale * W) if native else None,
        ranges=make_ranges(seed + 2, T, B, scale * H, scale * W) if ranges else None,
    )
