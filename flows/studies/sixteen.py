"""The logs of the Industrial Benchmark, as words of a study's command line."""

from typing import Final

__all__ = ["SIXTEEN"]

_SHARES: Final = {"bad": range(0, 9, 2), "mediocre": range(0, 11, 2), "optimized": range(0, 9, 2)}

SIXTEEN: Final = (
    "datasets=["
    + ",".join(f"{who}-{n / 10:.1f}" for who, shares in _SHARES.items() for n in shares)
    + "]"
)
