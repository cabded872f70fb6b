"""What a method costs where it runs."""

from essjax.deploy.cost import Cost, method_cost, multiply_adds

__all__ = ["Cost", "method_cost", "multiply_adds"]
