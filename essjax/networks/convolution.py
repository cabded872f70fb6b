"""A stride-1 convolution whose gradient stays fast inside ``lax.scan`` on CPUs.

XLA:CPU lays out the gradients of a convolution in a loop such that they miss its fast routine and run about 20 times
slower (docs/adr/0006-scan-friendly-convolution.md). Written out as plain NHWC convolutions they do not. On other
backends the ordinary convolution is used.
"""

import jax
import jax.numpy as jnp
from jax import lax

_NHWC = ("NHWC", "HWIO", "NHWC")


@jax.custom_vjp
def _convolve(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=_NHWC)


def _forward(x, kernel):
    return _convolve(x, kernel), (x, kernel)


def _backward(residuals, gradient):
    x, kernel = residuals
    flipped = jnp.swapaxes(kernel[::-1, ::-1], 2, 3)
    dx = lax.conv_general_dilated(gradient, flipped, (1, 1), "SAME", dimension_numbers=_NHWC)
    # The kernel's gradient correlates input and output gradient: channels take the place of the batch, the image that
    # of the kernel.
    height, width = kernel.shape[0] // 2, kernel.shape[1] // 2
    dw = lax.conv_general_dilated(
        jnp.transpose(x, (3, 1, 2, 0)),
        jnp.transpose(gradient, (1, 2, 0, 3)),
        (1, 1),
        [(height, height), (width, width)],
        dimension_numbers=_NHWC,
    )
    return dx, jnp.transpose(dw, (1, 2, 0, 3))


_convolve.defvjp(_forward, _backward)


def scan_friendly_convolution(lhs, rhs, window_strides, padding, *, lhs_dilation=None, rhs_dilation=None, **options):
    """``lax.conv_general_dilated`` for linen's ``conv_general_dilated=``: stride 1, odd kernel, "SAME", NHWC.

    Anything else, and every backend but the CPU, falls through to the ordinary one.
    """
    simple = tuple(window_strides) == (1, 1) and options.get("feature_group_count", 1) == 1
    simple &= all(d in (None, (1, 1), [1, 1]) or tuple(d) == (1, 1) for d in (lhs_dilation, rhs_dilation))
    simple &= rhs.shape[0] % 2 == 1 and rhs.shape[1] % 2 == 1
    same = [((n - 1) // 2, n // 2) for n in rhs.shape[:2]]
    simple &= padding == "SAME" or [tuple(p) for p in padding] == same
    if simple and jax.default_backend() == "cpu":
        return _convolve(lhs, rhs)
    return lax.conv_general_dilated(
        lhs, rhs, window_strides, padding, lhs_dilation=lhs_dilation, rhs_dilation=rhs_dilation, **options
    )
