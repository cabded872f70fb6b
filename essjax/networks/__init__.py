"""Flax modules behind ``Network(init, apply)``; the only package that imports flax."""

from essjax.networks.classifier import classifier_network, composition_network
from essjax.networks.dlctus import dlctus_network
from essjax.networks.extranet import extranet
from essjax.networks.extrassnet import extrassnet
from essjax.networks.fasset import fasset
from essjax.networks.frnet import frnet
from essjax.networks.ifrnet import ifrnet
from essjax.networks.nsrr import nsrr
from essjax.networks.precision import compute_dtype

__all__ = [
    "classifier_network", "composition_network", "compute_dtype", "dlctus_network", "extranet", "extrassnet", "fasset",
    "frnet", "ifrnet", "nsrr",
]  # fmt: skip
