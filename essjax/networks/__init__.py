"""Flax modules behind ``Network(init, apply)``; the only package that imports flax."""

from essjax.networks._extranet import extranet
from essjax.networks._extrassnet import extrassnet
from essjax.networks._fasset import fasset
from essjax.networks._frnet import frnet
from essjax.networks._ifrnet import ifrnet
from essjax.networks._nsrr import nsrr
from essjax.networks.classifier import classifier_network, composition_network
from essjax.networks.dlctus import dlctus_network
from essjax.networks.precision import compute_dtype

__all__ = [
    "classifier_network", "composition_network", "compute_dtype", "dlctus_network", "extranet", "extrassnet", "fasset",
    "frnet", "ifrnet", "nsrr",
]  # fmt: skip
