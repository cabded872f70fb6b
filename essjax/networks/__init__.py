"""Flax modules behind ``Network(init, apply)``; the only package that imports flax."""

<<<<<<< HEAD
from essjax.networks.extranet import extranet
=======
from essjax.networks.dlctus import dlctus_network
>>>>>>> main
from essjax.networks.extrassnet import extrassnet
from essjax.networks.frnet import frnet
from essjax.networks.nsrr import nsrr

<<<<<<< HEAD
__all__ = ["extranet", "extrassnet", "frnet"]
=======
__all__ = ["dlctus_network", "extrassnet", "frnet", "nsrr"]
>>>>>>> main
