"""Search spaces: per model the varied fields, each with a range or a list of choices.

A search never varies what decides the meaning or the cost of the held-out loss: the held-out share,
the predicted steps, the budget, the number of members. Every space is widened to hold the
configuration it starts from, so that this one can be the first trial.

The losses of a study are comparable. Those of one-step ensembles, autoencoders and behaviour
policies are over the same held-out transitions whatever is varied. Those of recurrent ensembles are
over all held-out windows of ``warm_up + horizon`` steps: a shorter warm-up leaves a few more of
them, at the beginning of each held-out trajectory (of 1,000 steps, 941 instead of 921 windows
between the two ends of the range), and is otherwise the harder task of the same predictions. It is
not searched beyond 30 steps, because policies see no more at run time. Whether they
predict values or changes, the loss is that of the values.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any, Final, Protocol

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from components.models.supervised import SCHEDULES

__all__ = [
    "SPACES",
    "VERSION",
    "Choice",
    "IntegerRange",
    "Parameter",
    "Range",
    "RangeOrZero",
    "Space",
    "distributions",
    "fixed",
    "parameters",
    "settings",
    "space_of",
]

_PASTS: Final = ("history", "warm_up")  # fields that say how many frames back a model looks

VERSION = 1
"""Raise it when the same parameters mean other settings."""


class Parameter(Protocol):
    """One varied field of a configuration."""

    def distribution(self, start: Any) -> BaseDistribution:
        """What Optuna draws from, widened to hold the setting a search starts from."""

    def setting(self, parameter: Any) -> Any:
        """The setting that a drawn value means."""

    def parameter(self, setting: Any) -> Any:
        """The drawn value that means a setting."""


Space = Mapping[str, Parameter]


def _three_digits(value: float) -> float:
    """Rounded to three digits: more would suggest a precision that no search has."""
    return float(f"{value:.3g}")


@dataclass(frozen=True)
class Range:
    """Real numbers between two ends, by default evenly on a logarithmic scale."""

    low: float
    high: float
    log: bool = True

    def distribution(self, start: float) -> BaseDistribution:
        """A float."""
        return FloatDistribution(min(self.low, start), max(self.high, start), log=self.log)

    def setting(self, parameter: float) -> float:
        """Rounded."""
        return _three_digits(parameter)

    def parameter(self, setting: float) -> float:
        """Itself."""
        return setting


@dataclass(frozen=True)
class RangeOrZero:
    """Zero, or a number on a logarithmic scale.

    Values are drawn from a decade below ``low`` on, and those of that decade mean zero: next to
    the smallest number, where it belongs.
    """

    low: float
    high: float

    def distribution(self, start: float) -> BaseDistribution:
        """A float."""
        low = min(self.low / 10, start) if start > 0 else self.low / 10
        return FloatDistribution(low, max(self.high, start), log=True)

    def setting(self, parameter: float) -> float:
        """Zero below the range."""
        return _three_digits(parameter) if parameter >= self.low else 0.0

    def parameter(self, setting: float) -> float:
        """The lowest one for zero."""
        return setting if setting > 0 else self.low / 10


@dataclass(frozen=True)
class IntegerRange:
    """IntegerRange numbers between two ends, evenly on a logarithmic scale."""

    low: int
    high: int

    def distribution(self, start: int) -> BaseDistribution:
        """A whole number."""
        return IntDistribution(min(self.low, start), max(self.high, start), log=True)

    def setting(self, parameter: int) -> int:
        """Itself."""
        return parameter

    def parameter(self, setting: int) -> int:
        """Itself."""
        return setting


@dataclass(frozen=True)
class Choice:
    """One of a few values; widths of layers, ``(400, 300)``, are shown as ``400-300``."""

    options: tuple[Any, ...]

    def distribution(self, start: Any) -> BaseDistribution:
        """A category."""
        extra = () if start in self.options else (start,)
        return CategoricalDistribution([self.parameter(o) for o in (*self.options, *extra)])

    def setting(self, parameter: Any) -> Any:
        """Widths from their text."""
        if isinstance(self.options[0], tuple):
            return tuple(int(width) for width in parameter.split("-"))
        return parameter

    def parameter(self, setting: Any) -> Any:
        """Widths as text: Optuna's categories are plain values."""
        return "-".join(map(str, setting)) if isinstance(setting, tuple) else setting


_MINIBATCHES: Space = {
    "batch": Choice((128, 256, 500, 512, 1024)),
    "learning_rate": Range(3e-5, 1e-2),
    "schedule": Choice(SCHEDULES),
    "weight_decay": RangeOrZero(1e-6, 1e-2),
}
_HISTORY = Choice((0, 2, 5, 10, 20))  # frames; 0: all 30 of an observation
_TARGET = Choice(("value", "change", "auto"))

SPACES: Final[Mapping[str, Space]] = MappingProxyType(
    {
        "behaviour_policy": {
            "hidden": Choice(((20,), (64,), (20, 20), (64, 64), (256,), (256, 256))),
            **_MINIBATCHES,
        },
        "gaussian_behaviour": {
            "hidden": Choice(((20,), (64, 64), (200,), (200, 200), (256, 256))),
            **_MINIBATCHES,
        },
        "action_vae": {
            "hidden": Choice(((100,), (100, 100), (300, 300), (750, 750))),
            "history": _HISTORY,
            **_MINIBATCHES,
        },
        "deterministic_ensemble": {
            "hidden": Choice(((100,), (100, 100), (200, 200), (400, 300), (200, 200, 200))),
            "history": _HISTORY,
            "target": _TARGET,
            **_MINIBATCHES,
        },
        "gaussian_ensemble": {
            "hidden": Choice(((100, 100), (200, 200), (200,) * 3, (200,) * 4, (400, 300))),
            "history": _HISTORY,
            "target": _TARGET,
            **_MINIBATCHES,
        },
        "residual_ensemble": {
            "hidden": Choice(((128, 128), (256, 256), (512,), (512, 512))),
            "history": _HISTORY,
            "target": _TARGET,
            **_MINIBATCHES,
        },
        "recurrent_ensemble": {
            "hidden": IntegerRange(15, 60),
            "target": Choice(("value", "change")),
            "warm_up": Choice((10, 20, 30)),
            "batch": Choice((128, 256, 512)),
            "learning_rate": Range(1e-3, 2e-2),
            "warm_fraction": Range(0.0, 0.4, log=False),
            "weight_decay": RangeOrZero(1e-6, 1e-2),
            "clip_norm": Range(0.1, 10.0),
        },
    }
)
"""By model of :data:`components.models.MODELS`."""


def space_of(model: str, frames: int) -> Space:
    """What a search varies.

    Args:
        model: Name of the model.
        frames: Frames of an observation. If one shows the whole state, how far back a model looks
            is not searched.
    """
    space = SPACES[model]
    if frames > 1:
        return space
    return {name: kind for name, kind in space.items() if name not in _PASTS}


def distributions(space: Space, start: Any) -> dict[str, BaseDistribution]:
    """What Optuna draws from, by field.

    Args:
        space: The varied fields.
        start: Configuration object the search starts from.
    """
    return {name: kind.distribution(getattr(start, name)) for name, kind in space.items()}


def parameters(space: Space, config: Any) -> dict[str, Any]:
    """The drawn values that mean a configuration's settings."""
    return {name: kind.parameter(getattr(config, name)) for name, kind in space.items()}


def settings(space: Space, start: Any, drawn: Mapping[str, Any]) -> Any:
    """The configuration object that drawn values mean.

    Args:
        space: The varied fields.
        start: Gives all other fields.
        drawn: A value per varied field.

    Raises:
        ValueError: The configuration's class refuses the combination.
    """
    unchanged = parameters(space, start)  # exact, so that rounding does not move the start
    changed = {
        name: kind.setting(drawn[name])
        for name, kind in space.items()
        if drawn[name] != unchanged[name]
    }
    return replace(start, **changed)


def fixed(space: Space, start: Any) -> dict[str, Any]:
    """The settings that a search leaves alone."""
    return {name: value for name, value in asdict(start).items() if name not in space}
