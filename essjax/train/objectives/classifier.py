"""Objectives of classifier-guided supersampling: first the classifier, on automatic labels, then the blending."""

import jax
import jax.numpy as jnp

from essjax.color import expose, reinhard
from essjax.frames import SampleRanges, Sequence
from essjax.interfaces import Method
from essjax.labels import ALIASING, DEFAULTS, GHOSTING, Thresholds, label_sequence
from essjax.losses import class_weights, cross_entropy, l1, masked_mean, temporal_l1
from essjax.rollout import SS, every, unroll
from essjax.train.objectives.common import Objective
from essjax.typing import Array, PyTree
from essjax.warp import nearest_upsample


def required_ranges(clip: Sequence) -> SampleRanges:
    """Return the clip's sample ranges; a ValueError says how to get them."""
    if clip.ranges is None:
        raise ValueError(
            "classifier: its labels are made of the ranges over all samples of each reference pixel, which this data "
            "does not have. Render the scenes with --ranges; imported frames have none."
        )
    return clip.ranges


def classification_objective(method: Method, *, thresholds: Thresholds = DEFAULTS, balance: float = 0.25) -> Objective:
    """Cross-entropy of both classes against automatic labels, classes balanced.

    First the method runs over the clip, as it does at inference; what its classifier saw is then classified again, all
    frames as one batch. Counter, ranges and previous logits so are those of inference, and BatchNorm's statistics are
    of all frames: frame by frame they would remove what is the same everywhere in a frame, such as the counter. Pixels
    without history are left out: they are visibility ghosting whatever the network says.

    Args:
      method: ``classifier``.
      thresholds: of the labels; ``Thresholds.of_height`` of the whole image, not of the crop.
      balance: see ``losses.class_weights``.
    """
    network = method.network("classifier")

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        ranges = required_ranges(clip)
        keep = lambda aux: {name: aux[name] for name in ("inputs", "known", "exposure")}  # noqa: E731
        given = jax.lax.stop_gradient(variables)
        seen = jax.lax.stop_gradient(unroll(method, given, clip.frames, every(), keep=keep).aux[SS])
        labels = label_sequence(ranges, clip.frames.cut, at=thresholds, exposure=seen["exposure"])
        inputs = seen["inputs"].reshape(-1, *seen["inputs"].shape[-3:])
        logits, state = network.apply(variables["classifier"], inputs, train=True)
        logits = logits.reshape(*seen["known"].shape[:-1], -1)
        terms = {}
        for name, part, names in (("ghosting", logits[..., :3], GHOSTING), ("aliasing", logits[..., 3:], ALIASING)):
            classes = getattr(labels, name)
            weight = class_weights(classes, len(names), seen["known"], balance=balance)
            terms[name] = masked_mean(cross_entropy(part, classes), weight)
        return terms, {"classifier": state}

    return objective


def composition_objective(method: Method, *, temporal_weight: float = 0.1) -> Objective:
    """L1 against the reference and, on valid history, against the warped previous output; the classifier is frozen.

    On x / (1 + x), in which the method blends. The first frame has nothing to blend and is left out.

    Args:
      method: ``classifier``.
      temporal_weight: of the second term.
    """

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        names = "encoded", "warped", "known", "exposure"
        keep = lambda aux: {name: aux[name] for name in names}  # noqa: E731
        # Not train: a frozen classifier uses the statistics that it was trained to, and the rest has none.
        kept = unroll(method, variables, clip.frames, every(), keep=keep).aux[SS]
        image, warped, valid, exposure = (kept[name][1:] for name in names)
        if clip.valid is not None:
            valid = valid * nearest_upsample(jnp.asarray(clip.valid[1:]), clip.size)
        terms = {
            "l1": jnp.mean(l1(image, reinhard(expose(clip.reference[1:], exposure)))),
            "temporal": temporal_weight * masked_mean(temporal_l1(image, warped, valid), valid),
        }
        return terms, {}

    return objective
