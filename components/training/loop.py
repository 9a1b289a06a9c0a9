"""The common training loop: budget, metrics, checkpoints, progress.

A learner defines one update and its own state; this module does the rest, for supervised models and
algorithms alike. The result depends on the learner and the step numbers alone, not on where
the loop is interrupted or when it saves.
"""

import math
import time
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import torch
from torch import Tensor

from components.core.integrity import DamagedFileError
from components.core.tensors import load_tensors, save_tensors
from components.core.version import code_version
from components.networks.stacked import select_lanes
from components.training.sums import MetricSums

FORMAT: Final = 1
"""Of checkpoints; raise it when their content changes."""

_REMEDY: Final = "delete it to train from the beginning"

__all__ = ["Curves", "Learner", "RunLearner", "TrainingLoop", "adam"]


class Learner(Protocol):
    """What the loop needs of a stack of L learners."""

    @property
    def lanes(self) -> int:
        """Number of lanes L."""

    def update(self, step: int) -> dict[str, Tensor]:
        """Do update number ``step`` (from 0) on all lanes; metrics ``[L]`` stay on the device."""

    def state_dict(self) -> dict[str, Tensor]:
        """All that the next update depends on, lane axis first in every tensor."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""


@runtime_checkable
class RunLearner(Learner, Protocol):
    """A learner that does several updates at once, to the same numbers."""

    def run_updates(self, first: int, count: int, sums: MetricSums) -> None:
        """Do updates ``first ... first + count - 1`` and add their metrics to ``sums``."""


@dataclass
class Curves:
    """Learning curves of L lanes: metric name -> (step number, values ``[L]``) pairs."""

    points: dict[str, list[tuple[int, Tensor]]] = field(default_factory=dict)

    def add(self, step: int, metrics: dict[str, Tensor]) -> None:
        """Append one point per metric."""
        for name, value in metrics.items():
            self.points.setdefault(name, []).append((step, value.detach().cpu()))

    def of_lane(self, lane: int) -> dict[str, tuple[list[int], list[float]]]:
        """Steps and values of one lane, up to the first step at which one is not finite."""
        last = self.ended_at(lane)
        return {
            name: tuple(map(list, zip(*kept, strict=True)))  # type: ignore[misc]
            for name, series in self.points.items()
            if (kept := [(s, float(v[lane])) for s, v in series if last is None or s < last])
        }

    def ended_at(self, lane: int) -> int | None:
        """The first step at which a metric of a lane is infinite or undefined, if there is one."""
        wrong = [
            step
            for series in self.points.values()
            for step, values in series
            if not math.isfinite(float(values[lane]))
        ]
        return min(wrong, default=None)

    def tensors(self) -> dict[str, Tensor]:
        """Values as ``[L, points]``, to be stored beside the learner's state."""
        return {name: torch.stack([v for _, v in p], dim=1) for name, p in self.points.items()}

    def steps(self) -> dict[str, list[int]]:
        """Step numbers of every metric's points."""
        return {name: [step for step, _ in series] for name, series in self.points.items()}


@dataclass
class TrainingLoop:
    """Run a learner for a number of updates, resumably.

    Attributes:
        steps: Budget in updates.
        members: Names of the lanes, in order; a checkpoint written for more lanes than these is
            cut down to them, so part of a stack can be finished without the rest.
        checkpoint: File to continue from and to save to; ``None`` trains in memory only.
        log_every: Updates between two points of the learning curves (means over the interval).
        save_every: Seconds between checkpoints.
        progress: Called with the finished fraction of the budget, 0 to 1.
    """

    steps: int
    members: Sequence[str]
    checkpoint: Path | None = None
    log_every: int = 50
    save_every: float = 20.0
    progress: Callable[[float], None] = lambda fraction: None

    @property
    def checkpoint_exists(self) -> bool:
        """Whether there is something to continue from."""
        return self.checkpoint is not None and self.checkpoint.is_file()

    def run(
        self,
        learner: Learner,
        after_update: Callable[[int, Curves], bool] = lambda done, curves: False,
        at: Container[int] | None = None,
    ) -> Curves:
        """Train until the budget is spent or ``after_update`` asks to stop.

        Between two events (ends of logging intervals and calls of ``after_update``) a
        :class:`RunLearner` does all updates in one call.

        Args:
            learner: Freshly initialised; its state is replaced if a checkpoint exists.
            after_update: Called with the number of finished updates and the curves so far, for
                snapshots and validation; returns whether to stop early.
            at: Numbers of finished updates at which ``after_update`` is called; None: at all.

        Returns:
            The learning curves from the first update on.

        Raises:
            DamagedFileError: The checkpoint is damaged, was written by another version, or belongs
                to another training.
        """
        curves, sums = Curves(), MetricSums()
        done, stopped = self._restore(learner, curves)
        saved = time.monotonic()
        while done < self.steps and not stopped:
            until = self._next_event(done, at)
            if isinstance(learner, RunLearner):
                learner.run_updates(done, until - done, sums)
            else:
                for step in range(done, until):
                    sums.add(learner.update(step))
            done = until
            if done % self.log_every == 0:
                curves.add(done, sums.means())
                sums.clear()
                self.progress(done / self.steps)
            if at is None or done in at:
                stopped = after_update(done, curves)
            # Only at the ends of intervals: a checkpoint does not hold unfinished metric sums.
            due = time.monotonic() - saved >= self.save_every and done % self.log_every == 0
            if due or stopped or done == self.steps:
                self._save(learner, curves, done, stopped)
                saved = time.monotonic()
        self.progress(1.0)
        return curves

    def _next_event(self, done: int, at: Container[int] | None) -> int:
        """The next number of finished updates at which something happens between updates."""
        if at is None:
            return done + 1
        end = min(done - done % self.log_every + self.log_every, self.steps)
        return next((n for n in range(done + 1, end) if n in at), end)

    def _save(self, learner: Learner, curves: Curves, done: int, stopped: bool) -> None:
        if self.checkpoint is None:
            return
        tensors = {f"learner.{k}": v for k, v in learner.state_dict().items()}
        tensors |= {f"curve.{k}": v for k, v in curves.tensors().items()}
        header = {
            "format": FORMAT,
            "package": code_version(),
            "done": done,
            "stopped": stopped,
            "members": list(self.members),
            "curve_steps": curves.steps(),
        }
        save_tensors(self.checkpoint, tensors, header)

    def _restore(self, learner: Learner, curves: Curves) -> tuple[int, bool]:
        if self.checkpoint is None or not self.checkpoint_exists:
            return 0, False
        tensors, header = load_tensors(self.checkpoint)
        try:
            self._check_origin(header)
            self._take(learner, curves, tensors, header)
            return int(header["done"]), bool(header["stopped"])
        except (DamagedFileError, torch.OutOfMemoryError):
            raise
        except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as error:
            said = f"{self.checkpoint} is no checkpoint of this training ({_line(error)})"
            raise DamagedFileError(said, self.checkpoint, _REMEDY) from error

    def _check_origin(self, header: Mapping[str, Any]) -> None:
        """Refuse what another version wrote, or what belongs to other lanes."""
        found = header.get("format"), header.get("package")
        if found != (FORMAT, code_version()):
            raise DamagedFileError(
                f"{self.checkpoint} was written by another version of this package "
                f"(format {found[0]}, version {found[1]})",
                self.checkpoint,
                _REMEDY,
            )
        stored = list(header["members"])
        missing = [name for name in self.members if name not in stored]
        if missing:
            said = f"{self.checkpoint} is a checkpoint of {stored} and lacks {missing}"
            raise DamagedFileError(said, self.checkpoint, _REMEDY)

    def _take(
        self,
        learner: Learner,
        curves: Curves,
        tensors: dict[str, Tensor],
        header: Mapping[str, Any],
    ) -> None:
        stored = list(header["members"])
        tensors = select_lanes(tensors, [stored.index(m) for m in self.members], len(stored))
        state = {
            k.removeprefix("learner."): v for k, v in tensors.items() if k.startswith("learner.")
        }
        # A learner takes what it knows, in whatever shape; here nothing may differ. Optimisers have
        # no state before their first step, so names can only be compared afterwards.
        kinds = _kinds(state)
        before = _kinds(learner.state_dict())
        learner.load_state_dict(state)
        after = _kinds(learner.state_dict())
        wrong = {name for name in before.keys() & kinds if before[name] != kinds[name]}
        wrong |= {name for name in after.keys() | kinds if after.get(name) != kinds.get(name)}
        if wrong:
            raise KeyError(f"missing, unexpected or of another shape: {', '.join(sorted(wrong))}")
        for name, steps in header["curve_steps"].items():
            values = tensors[f"curve.{name}"]
            curves.points[name] = [(step, values[:, i]) for i, step in enumerate(steps)]


def _kinds(tensors: Mapping[str, Tensor]) -> dict[str, tuple[torch.Size, torch.dtype]]:
    return {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}


def _line(error: Exception) -> str:
    text = str(error.args[0]) if error.args else type(error).__name__
    return " ".join(text.split())[:300].rstrip(".")


def adam(
    parameters: Sequence[Tensor], learning_rate: float, weight_decay: float = 0.0
) -> torch.optim.Adam:
    """Adam over stacked parameters in one fused kernel; element-wise, so lanes stay independent."""
    parameters = list(parameters)
    device = parameters[0].device
    return torch.optim.Adam(
        parameters,
        lr=torch.tensor(learning_rate, device=device) if device.type == "cuda" else learning_rate,
        weight_decay=weight_decay,
        fused=True,
        capturable=device.type == "cuda",  # by graphs, which read the learning rate from memory
    )
