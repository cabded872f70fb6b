"""Experiments: ``python -m experiments.run --variant NAME``."""
