"""What a method costs where it runs."""

from essjax.deploy.cost import Cost, count_parameters, example_frame, method_cost, multiply_adds

__all__ = ["Cost", "count_parameters", "example_frame", "method_cost", "multiply_adds"]
