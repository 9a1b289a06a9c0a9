"""Ranges of the fields that several dataset sources have."""

__all__ = ["check_exploration_and_discount"]


def check_exploration_and_discount(epsilon: float, discount: float) -> None:
    """Refuse values outside their range.

    Raises:
        ValueError: Naming the field and its range.
    """
    if not 0.0 <= epsilon <= 1.0:
        raise ValueError(f"epsilon is {epsilon}; give a number from 0 to 1.")
    if not 0.0 < discount <= 1.0:
        raise ValueError(f"discount is {discount}; give a number above 0, at most 1.")
