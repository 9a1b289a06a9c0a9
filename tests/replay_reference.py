"""Replay a recorded run of the reference Industrial Benchmark and measure the difference.

`python -m tests.replay_reference FILE --setpoint P --seed S` prints the largest absolute deviation
over all columns. Exit code 0: below 1e-6; 1: not; 2: the input cannot be used.

A recording (.csv or .csv.gz, 29 columns without header, one row per step) was made with uniform
random actions from one legacy `numpy.random.RandomState(seed)`, whose draws are repeated here in
their recorded order. The columns are named in `COLUMNS`.
"""

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from components.environments.industrial.benchmark import IndustrialBenchmark
from components.environments.industrial.noise import saturate, squash

__all__ = ["COLUMNS", "TOLERANCE", "RecordedNoise", "main", "read_recording", "replay"]

TOLERANCE = 1e-6
"""Far above the rounding of 1,000 steps (about 1e-12), far below any change of a constant."""

COLUMNS = (
    *(f"operational_cost_{lag}" for lag in range(9, -1, -1)),
    "current_operational_cost",
    "hidden_gain",
    "hidden_velocity",
    "effective_shift",
    "domain",
    "response",
    "direction",
    "effective_gain",
    "effective_velocity",
    "negative_potential",
    "consumption",
    "setpoint",
    "velocity",
    "gain",
    "shift",
    "fatigue",
    "basic_fatigue",
    "convolved_cost",
    "reward",
)

Array = NDArray[np.float64]


class RecordedNoise:
    """The draws of a single copy in the order in which the reference took them."""

    def __init__(self, random: np.random.RandomState) -> None:
        self._random = random

    def fatigue(self, effective: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Two exponentials, two uniforms, two binomials; gain before velocity."""
        velocity, gain = np.clip(effective[:, 0], 0.001, 0.999)
        exponential = np.array([[self._random.exponential(0.1)] for _ in range(2)])
        uniform = np.array([[self._random.rand()] for _ in range(2)])
        binary = np.array([[self._random.binomial(1, chance)] for chance in (gain, velocity)])
        return squash(exponential[::-1]), uniform[::-1], binary[::-1].astype(np.bool_)

    def saturation(self, saturated: NDArray[np.bool_]) -> Array:
        """The reference draws normal(2.4, 0.4), and only when the fatigue has saturated."""
        if not saturated[0]:
            return np.zeros(1)
        return saturate(np.array([(self._random.normal(2.4, 0.4) - 2.4) / 0.4]))

    def consumption(self) -> Array:
        """The reference subtracts its noise."""
        return np.array([-self._random.randn()])


def read_recording(path: Path) -> Array:
    """A recording as `[steps, 29]`.

    Raises:
        ValueError: the file is missing, unreadable or has another format.
    """
    if not path.is_file():
        raise ValueError(f"there is no recording at {path}; give the path of a .csv or .csv.gz.")
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2, dtype=np.float64)
    except (OSError, EOFError, ValueError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{path} cannot be read as numbers separated by commas: {reason}"
        ) from error
    if rows.shape[0] == 0 or rows.shape[1] != len(COLUMNS):
        raise ValueError(
            f"{path} holds {rows.shape[0]} rows of {rows.shape[1]} columns; a recording has at "
            f"least one row and {len(COLUMNS)} columns."
        )
    return rows


def replay(steps: int, setpoint: float, seed: int) -> Array:
    """Rows `[steps, 29]` that the environment gives under the recorded draws."""
    random = np.random.RandomState(seed)
    random.randint(1, 100)  # set-point schedule of the reference, unused here
    random.rand()
    random.rand()
    noise = RecordedNoise(random)
    environment = IndustrialBenchmark(copies=1, setpoint=setpoint)
    environment.reset(noise=noise)
    rows = np.empty((steps, len(COLUMNS)))
    for row in rows:
        environment.step(2.0 * random.rand(1, 3) - 1.0, noise)
        state = environment.state()
        costs = state["operational_costs"][0]
        row[:10] = costs
        row[10] = costs[-1]
        row[19] = -state["potential"][0]
        row[28] = 100.0 * state["reward"][0]
        for column, name in enumerate(COLUMNS):
            if name in state and name != "reward":
                row[column] = state[name][0]
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.replay_reference", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--setpoint", type=float, required=True)
    parser.add_argument("--seed", type=int, required=True)
    options = parser.parse_args(arguments)
    try:
        if not 0 <= options.seed < 2**32:
            raise ValueError(f"seed is {options.seed}; give a whole number from 0 to {2**32 - 1}.")
        recorded = read_recording(options.file)
        replayed = replay(len(recorded), options.setpoint, options.seed)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    deviations = np.abs(replayed - recorded).max(axis=0)
    largest = float(np.nan_to_num(deviations, nan=math.inf).max())
    worst = COLUMNS[int(np.nan_to_num(deviations, nan=math.inf).argmax())]
    print(f"{largest:.3e} largest absolute deviation ({worst}, {len(recorded)} steps)")
    return 0 if largest < TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
