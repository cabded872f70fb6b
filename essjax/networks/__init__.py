"""Flax modules behind ``Network(init, apply)``; the only package that imports flax."""

from essjax.networks.extrassnet import extrassnet
from essjax.networks.fasset import fasset
from essjax.networks.frnet import frnet

__all__ = ["extrassnet", "fasset", "frnet"]
