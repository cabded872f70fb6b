"""Flax modules behind ``Network(init, apply)``; the only package that imports flax."""

from essjax.networks.extranet import extranet
from essjax.networks.extrassnet import extrassnet
from essjax.networks.frnet import frnet

__all__ = ["extranet", "extrassnet", "frnet"]
