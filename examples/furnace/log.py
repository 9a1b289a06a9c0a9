"""What the plant's historian wrote: shifts under the controller, as one CSV file."""

from pathlib import Path

import numpy as np
import pandas as pd

from examples.furnace.controller import Operators
from examples.furnace.plant import BOUNDS, FEATURES, STEP, Furnaces

__all__ = ["logged", "write_log"]


def logged(shifts: int, rows: int, boldness: float, seed: int) -> pd.DataFrame:
    """Simulate shifts of the furnace, each from another morning on.

    Args:
        shifts: How many.
        rows: Of each.
        boldness: Of the operators, see :class:`.Operators`.
        seed: Of everything random.

    Returns:
        Rows of all shifts, one after the other. All values of a row belong to one moment, so the
        profit in it is that of the 30 seconds before.
    """
    furnaces, operators = Furnaces(shifts, seed), Operators(shifts, seed + 1, boldness)
    settings, _ = operators.act(furnaces.read())
    profit = furnaces.step(*settings.T)  # before the log begins
    moments = []
    for _ in range(rows):
        readings = furnaces.read()
        settings, manual = operators.act(readings)
        moments.append(np.column_stack([readings, settings, manual, profit]))
        profit = furnaces.step(*settings.T)
    columns = [*FEATURES, *BOUNDS, "manual", "profit"]
    values = np.stack(moments, axis=1).reshape(shifts * rows, len(columns))
    shift, row = np.divmod(np.arange(shifts * rows), rows)
    begin = np.datetime64("2026-03-02T06:00:00")
    seconds = (shift * 24 * 3600 + row * STEP).astype("timedelta64[s]")
    table = pd.DataFrame(values, columns=columns).round(3)
    table.insert(0, "time", begin + seconds)
    table.insert(1, "shift", shift + 1)
    return table.astype({"manual": int})


def write_log(path: Path, shifts: int, rows: int, boldness: float, seed: int) -> pd.DataFrame:
    """Write the log of some shifts as CSV and return it."""
    table = logged(shifts, rows, boldness, seed)
    table.to_csv(path, index=False)
    return table
