"""The grid of proximities at which policies are tried."""

__all__ = ["check_proximity_step", "proximity_grid"]


def check_proximity_step(step: float) -> None:
    """Refuse a step that does not lead from 0 to 1.

    Raises:
        ValueError: It does not divide 1, or is below 0.01: curves over the proximity count their
            points in whole percent.
    """
    if not 0.01 <= step <= 1 or abs(round(1 / step) * step - 1) > 1e-9:
        raise ValueError(f"proximity_step must divide 1 and be at least 0.01, got {step}.")


def proximity_grid(step: float) -> tuple[float, ...]:
    """The grid 0, step, ..., 1."""
    count = round(1 / step)
    return tuple(n / count for n in range(count + 1))
