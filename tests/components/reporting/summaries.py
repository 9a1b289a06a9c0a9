"""Summaries as aggregation stores them."""

from typing import Any


def point(proximity: float | None, mean: float = -70.0) -> dict[str, Any]:
    """Statistics of one pool."""
    return {
        "lambda": proximity,
        "policies": 10,
        "tenth_percentile": mean - 5.123456789,
        "standard_error": 0.25,
        "mean": mean,
        "std": 1.5,
        "iqm": mean + 0.125,
        "seed_std": 2.0,
        "distance": 0.5 if proximity is None else proximity / 2,
    }


TD3_BC = {
    "dataset": "mediocre-0.2",
    "algorithm": "td3_bc",
    "seeds": [0, 1, 2, 3, 4],
    "points": [point(None, -77.0)],
}
LION = {
    "dataset": "mediocre-0.2",
    "algorithm": "lion",
    "seeds": [0, 1],
    "points": [point(0.0, -90.0), point(0.5, -70.0), point(1.0, -80.0)],
}
