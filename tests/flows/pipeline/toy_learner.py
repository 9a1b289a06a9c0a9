"""A learner whose checkpoints are those of all learners."""

from pathlib import Path

import torch
from torch import Tensor

from components.training.loop import TrainingLoop

__all__ = ["learn"]


class Sum:
    """Adds a number in every update; fails at the step `hold` unless a file named `go` is there."""

    lanes = 1

    def __init__(self, number: float, hold: int, log: Path) -> None:
        self._number, self._hold, self._log = number, hold, log
        self.total = torch.zeros(1)

    def update(self, step: int) -> dict[str, Tensor]:
        if step == self._hold and not (self._log / "go").exists():
            raise ValueError("this toy holds here")
        self.total = self.total + self._number
        return {"total": self.total}

    def state_dict(self) -> dict[str, Tensor]:
        return {"total": self.total}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.total = state["total"]


def learn(checkpoint: Path, name: str, number: float, steps: int, hold: int, log: Path) -> float:
    """The sum after all steps, with a checkpoint after each."""
    learner = Sum(number, hold, log)
    TrainingLoop(steps, [name], checkpoint, 1, 0.0).run(learner)
    return float(learner.total)
