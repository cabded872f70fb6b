"""The cost of a method where it runs."""

from essjax.deploy.cost import Cost, count_parameters, method_cost, multiply_adds

__all__ = ["Cost", "count_parameters", "method_cost", "multiply_adds"]
