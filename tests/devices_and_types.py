"""Run by ``test_programs.py`` as a program of its own: two devices and 64-bit types are asked for before JAX starts."""

import os

os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2"
os.environ["JAX_ENABLE_X64"] = "1"

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax.sharding import Mesh, PartitionSpec  # noqa: E402

from essjax import methods, rollout, warp  # noqa: E402
from essjax.frames import select_time  # noqa: E402
from essjax.networks.convolution import scan_friendly_convolution  # noqa: E402
from experiments.benchmark import inputs  # noqa: E402

ALONG = PartitionSpec("data")
EVERYWHERE = PartitionSpec()
MESH = Mesh(np.array(jax.devices()), ("data",))
METHODS = ("extrass", "nsrr", "dlctus", "classifier", "taau")


def random(seed: int, *shape: int):
    return jnp.asarray(np.random.default_rng(seed).uniform(size=shape), jnp.float32)


def float32_stays_float32() -> None:
    """Where 64-bit types are switched on, 32-bit frames give 32-bit images (and scans keep their carries)."""
    frames = jax.tree.map(lambda *leaves: np.stack(leaves), *inputs.frames(4, 32, 32))
    for name in METHODS:
        method = getattr(methods, name)()
        variables = jax.eval_shape(method.init, jax.random.key(0), select_time(frames, 0))
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(variables)), name
        schedule = rollout.every() if method.info.renders_all else rollout.alternate()

        def run(variables, frames, method=method, schedule=schedule):
            return rollout.unroll(method, variables, frames, schedule).image

        assert jax.eval_shape(run, variables, frames).dtype == jnp.float32, name


def guided_warp_runs_with_64_bit_types() -> None:
    image, guide, motion = random(1, 9, 7, 3), random(2, 9, 7, 6), 3.0 * random(3, 9, 7, 2)
    warped = jax.jit(warp.gbuffer_guided_warp)(image, guide, guide, motion)
    slow = warp.gbuffer_guided_warp(image, guide, guide, motion, implementation="reference")
    assert warped.dtype == jnp.float32
    np.testing.assert_allclose(warped, slow, atol=1e-6)


def devices_share_a_batch() -> None:
    """Under shard_map: warps and their gradients, and the gradient of a kernel that all devices hold."""
    image, guide, motion = random(1, 2, 9, 7, 3), random(2, 2, 9, 7, 6), 3.0 * random(3, 2, 9, 7, 2)
    guided = lambda image, motion: warp.gbuffer_guided_warp(image, guide[:1], guide[:1], motion)
    bicubic = jax.grad(lambda image, motion: (warp.backward_warp(image, motion, mode="bicubic") ** 2).sum(), (0, 1))
    for call in (guided, bicubic):
        shared = jax.jit(jax.shard_map(call, mesh=MESH, in_specs=ALONG, out_specs=ALONG))(image, motion)
        for ours, alone in zip(jax.tree.leaves(shared), jax.tree.leaves(jax.jit(call)(image, motion)), strict=True):
            np.testing.assert_allclose(ours, alone, atol=1e-4)

    x, padding = random(4, 4, 8, 8, 6), ((1, 1), (1, 1))
    for stride, outputs, groups in ((1, 4, 1), (2, 4, 1), (1, 6, 6)):
        kernel = random(5, 3, 3, 6 // groups, outputs)

        def loss(kernel, x, stride=stride, groups=groups):
            names = {"dimension_numbers": ("NHWC", "HWIO", "NHWC"), "feature_group_count": groups}
            return (scan_friendly_convolution(x, kernel, (stride, stride), padding, **names) ** 2).sum()

        def total(kernel, x, loss=loss):
            return jax.grad(lambda kernel: jax.lax.psum(loss(kernel, x), "data"))(kernel)

        shared = jax.jit(jax.shard_map(total, mesh=MESH, in_specs=(EVERYWHERE, ALONG), out_specs=EVERYWHERE))
        np.testing.assert_allclose(shared(kernel, x), jax.jit(jax.grad(loss))(kernel, x), rtol=1e-4)


if __name__ == "__main__":
    assert len(jax.devices()) == 2
    guided_warp_runs_with_64_bit_types()
    devices_share_a_batch()
    float32_stays_float32()
    print("done")
