"""Kills training at chosen updates, and saves a checkpoint at every interval's end."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from components.training.loop import Curves, TrainingLoop


class KilledError(Exception):
    """Stands for a kill."""


def dying(update: Callable[..., Any], death: int | None) -> Callable[..., Any]:
    """The update that does not survive step ``death``."""

    def wrapped(*arguments: Any) -> Any:
        if arguments[-1] == death:
            raise KilledError
        return update(*arguments)

    return wrapped


def save_always(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> None:
    """Make a module's training loop save as often as it can, every ten updates."""
    loop = functools.partial(TrainingLoop, save_every=0.0)

    def every_ten(*arguments: Any, **options: Any) -> TrainingLoop:
        made = loop(*arguments, **options)
        made.log_every = min(made.log_every, 10)
        return made

    monkeypatch.setattr(module, "TrainingLoop", every_ten)


def killed_at(
    deaths: Sequence[int],
    learner: type,
    fit: Callable[[Path], Any],
    checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Any:
    """Run ``fit(checkpoint)`` once per death, and then to its end."""
    original = learner.update  # type: ignore[attr-defined]
    for death in deaths:
        monkeypatch.setattr(learner, "update", dying(original, death))
        with pytest.raises(KilledError):
            fit(checkpoint)
    monkeypatch.setattr(learner, "update", original)
    return fit(checkpoint)


def lanes(curves: Curves, count: int) -> list[Any]:
    """Curves as plain lists, to be compared for equality."""
    return [curves.of_lane(lane) for lane in range(count)]
