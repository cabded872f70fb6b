"""IFRNet as a method (Kong et al. 2022): optical flow alone, no G-buffers; one frame of latency.

What ExtraSS compares with in Tables 2 and 3. Both rendered frames and the wanted one have jitters of their own. An
engine knows them: their differences are where the flows start, so that the network looks for motion only and its output
lies at the wanted frame's samples.
"""

import jax
import jax.numpy as jnp

from essjax.color import expm1, log1p
from essjax.interfaces import Method
from essjax.methods.interpolation import interpolator
from essjax.methods.registry import registered
from essjax.networks._ifrnet import ifrnet as ifrnet_network


@registered
def ifrnet(*, width: int = 24) -> Method:
    """Interpolates between rendered frames, at their resolution.

    ``variables = {"ifrnet": ...}``. A rendered step's ``aux`` is what the network returns (``networks.ifrnet``) for the
    frame before it. Untrained it returns the mean of both frames, each read at the wanted samples.

    Args:
      width: of the network; 24 is the published small model, 32 the standard one.
    """
    network = ifrnet_network(width=width)

    def init(key, example):
        *lead, height, wide, _ = example.motion.shape
        images = jax.ShapeDtypeStruct((2, *lead, height, wide, 3), jnp.float32)
        return {"ifrnet": network.init(key, images, jax.ShapeDtypeStruct((2, *lead, 2), jnp.float32))}

    def between(variables, pair, train):
        images = log1p(jnp.stack([pair.earlier.color, pair.later.color]))
        prior = jnp.stack([pair.jitter - pair.jitter_earlier, pair.jitter - pair.jitter_later])
        output, _ = network.apply(variables["ifrnet"], images, prior, train=train)
        return expm1(output["image"]), output

    return interpolator("ifrnet", between, init=init)._replace(networks=(("ifrnet", network),))
