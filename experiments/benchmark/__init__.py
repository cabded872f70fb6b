"""``python -m experiments.benchmark``: how fast everything is, beside what people would otherwise run."""
