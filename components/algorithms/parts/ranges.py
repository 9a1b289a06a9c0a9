"""Checks of settings that several algorithms have; their errors name the fields."""

__all__ = ["check_at_least_one", "check_bootstrapping", "check_virtual_starts"]


def check_at_least_one(config: object, *names: str) -> None:
    """Refuse counts below 1; a field may hold several of them, such as layer widths.

    Raises:
        ValueError: Naming all these fields.
    """
    values = [getattr(config, name) for name in names]
    if any(min(v, default=1) < 1 if isinstance(v, tuple) else v < 1 for v in values):
        *others, last = names
        listed = " and ".join([", ".join(others), last] if others else [last])
        raise ValueError(f"{listed} must be at least 1.")


def check_bootstrapping(discount: float, target_rate: float) -> None:
    """Refuse values of ``discount`` and ``target_rate`` with which critics could not learn.

    Raises:
        ValueError: Naming both.
    """
    if not 0 < discount < 1 or not 0 < target_rate <= 1:
        raise ValueError("discount must lie in (0, 1) and target_rate in (0, 1].")


def check_virtual_starts(discount: float, start_window: int, start_after: int) -> None:
    """Refuse virtual trajectories without any start state, or whose return grows with time.

    Raises:
        ValueError: Naming the field.
    """
    if not 0 <= start_after < start_window:
        raise ValueError("start_after must not be negative and lie below start_window.")
    if not 0 < discount <= 1:
        raise ValueError(f"discount must lie in (0, 1], got {discount}.")
