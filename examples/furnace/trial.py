"""The trial on the plant: exported policies and the operators, each on the same furnaces.

A policy is nothing but its ONNX file here, run by ONNX Runtime as on a computer beside the plant.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnxruntime
import pandas as pd

from examples.furnace.controller import Operators
from examples.furnace.plant import BOUNDS, FEATURES, STEP, Furnaces

__all__ = ["Exported", "operators_trial", "policy_trials", "returns_of"]

Numbers = npt.NDArray[np.float64]
Act = Callable[[Numbers], Numbers]
"""From new readings `[N, F]` to what is set, `[N, 2]`."""

_WEATHER: Final = 12345
"""Seed of the furnaces of the trial, which no log has seen."""
_HORIZON: Final = 100
"""Steps that count for a return, as they do for judges."""
_DISCOUNT: Final = 0.97
"""Of a return, as in the schema of the log."""


class Exported:
    """An exported policy that acts on N furnaces.

    Args:
        path: The file.
        proximity: λ, for policies that take one.

    Raises:
        ValueError: The policy is one of another plant.
    """

    def __init__(self, path: Path, proximity: float | None) -> None:
        self._session = onnxruntime.InferenceSession(path)
        self.card: dict[str, Any] = json.loads(
            self._session.get_modelmeta().custom_metadata_map["card.json"]
        )
        history, actions = self.card["inputs"]["history"], self.card["output"]["actions"]
        if (history["features"], actions) != ([*FEATURES], [*BOUNDS]):
            raise ValueError(f"{path} is a policy of another plant; export one of this log.")
        self._rows: int = history["shape"][1]
        self._proximity = proximity
        self._history: npt.NDArray[np.float32] | None = None

    def act(self, readings: Numbers) -> Numbers:
        """What to set `[N, 2]` after new readings `[N, F]`; the newest come first."""
        newest = readings.astype(np.float32)[:, None]
        if self._history is None:
            self._history = np.repeat(newest, self._rows, axis=1)
        else:
            self._history = np.concatenate([newest, self._history[:, :-1]], axis=1)
        given = {"history": self._history}
        if self._proximity is not None:
            given["proximity"] = np.full(len(readings), self._proximity, np.float32)
        chosen: Numbers = np.asarray(self._session.run(None, given)[0], np.float64)
        return chosen


def returns_of(act: Act, shifts: int, rows: int) -> dict[str, float]:
    """Let somebody run furnaces for a shift each.

    Args:
        act: Who.
        shifts: How many furnaces.
        rows: Steps of a shift.

    Returns:
        Means over the furnaces: discounted `return`, its `standard_error`, `euros_per_hour` of the
        whole shift, `temperature`, `oxygen`, `set_point` and `ratio`.
    """
    furnaces, profits, readings, settings = Furnaces(shifts, _WEATHER), [], [], []
    for _ in range(rows):
        readings.append(furnaces.read())
        settings.append(act(readings[-1]))
        profits.append(furnaces.step(*settings[-1].T))
    earned, read, chosen = np.array(profits), np.array(readings), np.array(settings)
    counted = earned[:_HORIZON]
    returns = (counted * _DISCOUNT ** np.arange(len(counted))[:, None]).sum(axis=0)
    return {
        "return": float(returns.mean()),
        "standard_error": float(returns.std(ddof=1) / shifts**0.5),
        "euros_per_hour": float(earned.mean()) * 3600 / STEP,
        "temperature": float(read[..., FEATURES.index("temperature")].mean()),
        "oxygen": float(read[..., FEATURES.index("oxygen")].mean()),
        "set_point": float(chosen[..., 0].mean()),
        "ratio": float(chosen[..., 1].mean()),
    }


def operators_trial(shifts: int, rows: int, boldness: float) -> dict[str, float]:
    """The operators on the furnaces of the trial, see :func:`returns_of`."""
    operators = Operators(shifts, _WEATHER, boldness)
    return returns_of(lambda readings: operators.act(readings)[0], shifts, rows)


def policy_trials(path: Path, proximities: Sequence[float], shifts: int, rows: int) -> pd.DataFrame:
    """An exported policy on the furnaces of the trial, at each proximity if it takes one."""
    takes = "proximity" in Exported(path, None).card["inputs"]
    trials = []
    for proximity in proximities if takes else [None]:
        found = returns_of(Exported(path, proximity).act, shifts, rows)
        trials.append({"proximity": np.nan if proximity is None else proximity, **found})
    return pd.DataFrame(trials)
