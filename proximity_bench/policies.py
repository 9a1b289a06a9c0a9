"""Policies as a program uses them: NumPy in, NumPy out, in the units of the log."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import Tensor

from components.core.files import replacing, write_text
from components.core.random_streams import lane_generator, lane_key
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.data.history import history_rows
from components.data.recorded_states import plant_of, recorded_states
from components.environments.systems import SYSTEMS
from components.evaluation.protocol import EvaluationProtocol
from components.evaluation.real import evaluate_policies
from components.policies.export import export_policy
from components.policies.policy import Policy as StoredPolicy
from components.policies.portable import Plant
from components.policies.portable_check import Checked, drawn_states
from proximity_bench.histories import checked_frames, checked_proximity, warn_of_strangers
from proximity_bench.progress import progress_bars

__all__ = ["BEHAVIOUR", "FORMAT", "ORIGIN", "Policy"]

FORMAT: Final = "proximity_bench/1"
ORIGIN: Final = "origin.json"
BEHAVIOUR: Final = "behaviour"
"""Names in the folder of a saved policy, and the format of its origin."""


@dataclass(frozen=True, eq=False, repr=False)
class Policy:
    """A trained policy, which acts with its newest snapshot.

    Attributes:
        stack: All its snapshots, the oldest first.
        seed: Of its training.
        log: Card of the log it learned from; None: unknown.
        behaviour: Clone of the log that distances are measured to; None: none was fitted.
    """

    stack: StoredPolicy
    seed: int = 0
    log: DatasetCard | None = None
    behaviour: StoredPolicy | None = None

    @property
    def algorithm(self) -> str:
        """The method that trained it."""
        return self.stack.card.algorithm

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the F values of a frame, in the order in which `act` wants them."""
        return self.stack.card.features

    @property
    def history(self) -> int:
        """Newest frames that it sees."""
        return self.stack.card.history

    @property
    def takes_proximity(self) -> bool:
        """Whether `act` wants a proximity."""
        return self.stack.card.takes_proximity

    @property
    def steps(self) -> tuple[int, ...]:
        """Updates after which its snapshots were taken."""
        return self.stack.card.steps

    @property
    def action_bounds(self) -> npt.NDArray[np.float64]:
        """`[A, 2]` smallest and largest value of each action, in the units of the log."""
        bounds = self.log.action_bounds if self.log is not None else ()
        return np.array(bounds or [(-1.0, 1.0)] * self.stack.card.actions)

    def __repr__(self) -> str:
        card, last = self.stack.card, self.steps[-1]
        return f"Policy({card.algorithm} on {card.dataset}, seed {self.seed}, update {last})"

    def at(self, step: int) -> "Policy":
        """The snapshot that was taken after so many updates.

        Raises:
            ValueError: There is none; names those that there are.
        """
        if step not in self.steps:
            known = ", ".join(map(str, self.steps))
            raise ValueError(f"There is no snapshot of update {step}; there are {known}.")
        number = self.steps.index(step)
        card = replace(self.stack.card, steps=(step,))
        return replace(self, stack=self.stack.lane(number, card))

    def act(
        self,
        history: npt.ArrayLike | pd.DataFrame | pd.Series,
        proximity: npt.ArrayLike | None = None,
        *,
        scaled: bool = False,
        noise: np.random.Generator | None = None,
    ) -> npt.NDArray[np.float64]:
        """Choose actions.

        Args:
            history: `[T, F]` frames in the units of the log, the newest last, or `[B, T, F]` of B
                machines. Fewer than `self.history` frames count as the beginning of an episode,
                before which its first frame repeats; of more, the newest are taken. A DataFrame
                gives its columns by name, a Series is one of its rows. Frames must follow each
                other at the log's interval within one episode: nothing here can see that.
            proximity: λ in [0, 1], or `[B]`; needed exactly by policies that take it.
            scaled: Return actions in [-1, 1] also where the log has bounds of its own.
            noise: From which BCQ and BEAR draw candidates; by default a stream of this policy.

        Returns:
            `[A]`, or `[B, A]`: in the units of the log where its card knows the bounds of the
            actions, else in [-1, 1]. A warning says so where a value lies so far from the log that
            its unit or its place is hardly right.

        Raises:
            ValueError: Other widths, values that are missing or infinite, a proximity that is
                missing, outside of [0, 1], or not wanted.
        """
        frames = checked_frames(history, self.features)  # [B, T, F] or [T, F]
        scaling = self._newest.frames
        warn_of_strangers(frames, self.features, scaling.mean[0], scaling.scale[0])
        seen = frames if frames.ndim == 3 else frames[None]
        newest = history_rows(np.asarray(seen.shape[1] - 1), np.asarray(0), self.history)
        chosen = self._newest.act(
            torch.from_numpy(seen[None, :, newest]),
            checked_proximity(proximity, len(seen), self.algorithm, wanted=self.takes_proximity),
            self._candidates(len(seen), noise),
        )
        actions = chosen[0].numpy().astype(np.float64)
        if not scaled:
            low, high = self.action_bounds.T
            actions = low + (actions + 1) / 2 * (high - low)
        return actions if frames.ndim == 3 else actions[0]

    def evaluate(
        self,
        trajectories: int = 10,
        *,
        horizon: int = 100,
        proximity_step: float = 0.05,
        threads: int = 1,
        progress: bool = True,
    ) -> pd.DataFrame:
        """Let the policy act in the real system that the log's card names, as a sweep does.

        Args:
            trajectories: For each proximity.
            horizon: Steps of a trajectory.
            proximity_step: Of the grid of proximities from 0 to 1.
            threads: That step robots.
            progress: Whether to show a bar.

        Returns:
            By `proximity` (NaN for policies without): mean discounted `return`, its
            `standard_error`, and the mean `distance` to the actions of the cloned behaviour (NaN
            without a clone).

        Raises:
            ValueError: There is no such system, or a number is out of range.
        """
        if self.log is None or self.log.environment not in SYSTEMS:
            raise ValueError(
                f"{self.stack.card.dataset} names no registered system, so its policies cannot be "
                f"evaluated; registered are {', '.join(SYSTEMS)}."
            )
        protocol = EvaluationProtocol(
            trajectories=trajectories, horizon=horizon, proximity_step=proximity_step
        )
        key = lane_key("evaluation", self.stack.card.dataset, self.algorithm, self.seed)
        with progress_bars(progress) as begin:
            [found] = evaluate_policies(
                [self._newest],
                None if self.behaviour is None else [self.behaviour],
                self.log.environment,
                self.log.environment_parameters,
                protocol,
                self.log.discount,
                [key],
                torch.device("cpu"),
                begin("evaluation"),
                threads,
            )
        returns = found.returns[0]  # [proximities, trajectories]
        spread = returns.std(axis=1, ddof=1) if trajectories > 1 else np.full(len(returns), np.nan)
        index = pd.Index(found.proximities, name="proximity")
        columns = {
            "return": returns.mean(axis=1),
            "standard_error": spread / np.sqrt(trajectories),
            "distance": found.distances[0],
        }
        return pd.DataFrame(columns, index)

    def save(self, folder: str | Path) -> None:
        """Store it in a new or empty folder, which appears complete or not at all.

        Raises:
            ValueError: The folder holds something already.
        """
        folder = Path(folder).expanduser()
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"{folder} is not empty; remove it or save the policy elsewhere.")
        folder.parent.mkdir(parents=True, exist_ok=True)
        log = None if self.log is None else json.loads(self.log.to_json())
        origin = {"format": FORMAT, "seed": self.seed, "log": log}
        with replacing(folder) as made:
            made.mkdir()
            if self.behaviour is not None:
                (made / BEHAVIOUR).mkdir()
                self.behaviour.save(made / BEHAVIOUR)
            write_text(made / ORIGIN, json.dumps(origin, indent=2) + "\n")
            self.stack.save(made)

    def export(
        self, path: str | Path, log: OfflineDataset | None = None, *, overwrite: bool = False
    ) -> Checked:
        """Write one file that acts as this policy without this project, see docs/export.md.

        The file is compared with the policy first, and not kept if it differs.

        Args:
            path: Ends in `.onnx` or `.pt2`.
            log: In whose recorded states it is compared; without one, the states are drawn from the
                moments of the policy's own scaling, and the file says so.
            overwrite: Whether it may replace a file that is there.

        Returns:
            How well the file agrees.

        Raises:
            ValueError: Another ending, a file that is there, a package that is missing, a log that
                has other features, or a file that differs.
        """
        if log is not None and log.card.frame_features != self.features:
            raise ValueError(
                f"The log {log.card.name} has other features; the policy sees "
                f"{', '.join(self.features)}."
            )
        newest, card = self._newest, self.log or (log.card if log is not None else None)
        if card is None:
            names = tuple(f"action {n}" for n in range(newest.card.actions))
            plant = Plant(actions=names)
        else:
            plant = plant_of(card)
        states = drawn_states(newest) if log is None else recorded_states(log, self.history)
        return export_policy(
            newest,
            Path(path).expanduser(),
            plant,
            states,
            {"seed": self.seed},
            overwrite=overwrite,
        )

    @cached_property
    def _newest(self) -> StoredPolicy:
        last = self.stack.lanes - 1
        return self.stack.lane(last, replace(self.stack.card, steps=self.steps[-1:]))

    @cached_property
    def _noise(self) -> np.random.Generator:
        key = lane_key(self.stack.card.dataset, self.algorithm, self.seed)
        return lane_generator(lane_key(key, "act"))

    def _candidates(self, machines: int, noise: np.random.Generator | None) -> Tensor | None:
        card = self.stack.card
        if not card.candidates:
            return None
        shape = (1, machines, card.candidates, card.noise)
        return torch.from_numpy((noise or self._noise).standard_normal(shape, np.float32))
