"""The judgement of policies: all estimates of what they are worth, with errors.

- ``model``: mean return over the members of an ensemble that was fitted to other trajectories than
  the policies, with its standard error; ``model_least``: by the member that gives the least.
- ``fitted_q``: value by fitted critics, with the standard error over replicas and start states.
- ``distance``: mean Euclidean distance to the behaviour policy's action in logged states.
- ``outside``: share of the steps in the ensemble that lie outside the log's support
  (:mod:`.support`); without an ensemble, of its actions in logged states.
- ``promised``: gain over the behaviour policy in the ensemble that the policy was trained in, where
  there is one: what training believes. It is no judge, since the policy was chosen by it.

Beside what policies are worth stands where they lead, ``frames``: between which values nearly all
frames of the trajectories in the ensemble lie, and ``held``: the share of them that is held at the
least or greatest value that the ensemble was fitted to. Its predictions end there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from components.core.random_streams import lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.pairs import spread_rows
from components.judging.config import JudgeConfig
from components.judging.fitted_q import policy_values
from components.judging.judged import JudgedPolicies
from components.judging.rollouts import VirtualWorld
from components.judging.support import Support
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.policies.policy import Policy

__all__ = ["Judgement", "judge"]

_LOGGED = 1000
"""States of the log in which the distance to the behaviour policy is measured."""
_OF_FRAMES = ("frames", "held")
_BLOCK = 4096  # states of the log in which policies act together


@dataclass(frozen=True)
class Judgement:
    """Estimates of Q policies, ``[Q]`` each; NaN where there is no ensemble to make them.

    The ``frames`` and ``held`` are ``[Q, 2, F]``: of the low and the high end.
    """

    model: NDArray[np.float64]
    model_error: NDArray[np.float64]
    model_least: NDArray[np.float64]
    fitted_q: NDArray[np.float64]
    fitted_q_error: NDArray[np.float64]
    distance: NDArray[np.float64]
    outside: NDArray[np.float64]
    promised: NDArray[np.float64]
    frames: NDArray[np.float64]
    held: NDArray[np.float64]

    @classmethod
    def names(cls) -> list[str]:
        """Of the estimates, without what is told of the frames."""
        return [f.name for f in fields(cls) if f.name not in _OF_FRAMES]

    @property
    def estimates(self) -> dict[str, NDArray[np.float64]]:
        """By name, ``[Q]`` each."""
        return {name: getattr(self, name) for name in self.names()}

    def part(self, policies: slice) -> "Judgement":
        """Estimates of some of the policies."""
        return Judgement(**{f.name: getattr(self, f.name)[policies] for f in fields(self)})


def judge(
    dataset: OfflineDataset,
    ensemble: RecurrentEnsemble | None,
    behaviour: Policy,
    judged: Sequence[JudgedPolicies],
    trained_in: Sequence[RecurrentEnsemble | None],
    config: JudgeConfig,
    device: torch.device,
    *,
    names: Sequence[str],
    checkpoint: Path | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Judgement]:
    """Judge policies of one log, all of them in one program.

    What a policy gets does not depend on the others.

    Args:
        dataset: The part of the log that they have not learned from.
        ensemble: Fitted to this part; None: there is none, and no estimate by a model.
        behaviour: Cloned from this part.
        judged: Stacks of policies.
        trained_in: For each stack, the ensemble that it was trained in; None if in none.
        config: Settings.
        device: Where to compute.
        names: One per stack, stable across restarts.
        checkpoint: File to resume from and save to.
        progress: Called with the finished fraction, 0 to 1.

    Returns:
        One judgement per stack.
    """
    judged = [JudgedPolicies(j.policy.to(device), j.proximities) for j in judged]
    world = VirtualWorld(dataset, config, device)
    values = [world.values(ensemble, one) if ensemble else None for one in judged]
    usual = JudgedPolicies.of(behaviour.to(device), ())
    promised = [
        torch.full((one.count,), torch.nan)
        if own is None
        else world.values(own, one).mean - world.values(own, usual).mean
        for own, one in zip(trained_in, judged, strict=True)
    ]
    familiar = (
        world.values(ensemble, usual).visited
        if ensemble
        else _Logged.of(world, dataset, usual).pairs
    )
    support = Support(dataset, familiar[0].numpy(), config.neighbours, config.quantile)
    logged = [_Logged.of(world, dataset, one) for one in judged]
    visited = [
        own.pairs if found is None else found.visited
        for found, own in zip(values, logged, strict=True)
    ]
    distances = [own.distances(usual.policy) for own in logged]

    def of_model(name: str) -> NDArray[np.float64]:
        return _joined(
            [
                torch.full((one.count,), torch.nan) if found is None else getattr(found, name)
                for found, one in zip(values, judged, strict=True)
            ]
        )

    def of_frames(name: str) -> NDArray[np.float64]:
        return _joined(
            [
                torch.full((one.count, 2, dataset.frames.shape[1]), torch.nan)
                if found is None
                else getattr(found, name)
                for found, one in zip(values, judged, strict=True)
            ]
        )

    fitted = _fitted(dataset, world, judged, config, device, names, checkpoint, progress)
    whole = Judgement(
        model=of_model("mean"),
        model_error=of_model("error"),
        model_least=of_model("least"),
        fitted_q=_joined([fitted.mean(dim=(0, 2))]),
        fitted_q_error=_joined([_error(fitted)]),
        distance=_joined(distances),
        outside=np.concatenate([support.outside(pairs.numpy()) for pairs in visited]),
        promised=_joined(promised),
        frames=of_frames("frames"),
        held=of_frames("held"),
    )
    ends = np.cumsum([one.count for one in judged])
    return [
        whole.part(slice(int(end) - one.count, int(end)))
        for one, end in zip(judged, ends, strict=True)
    ]


@dataclass(frozen=True)
class _Logged:
    """What Q policies do in logged states.

    Attributes:
        histories: ``[V, H, F]``.
        actions: ``[Q, V, A]``.
    """

    histories: Tensor
    actions: Tensor

    @classmethod
    def of(cls, world: VirtualWorld, dataset: OfflineDataset, judged: JudgedPolicies) -> "_Logged":
        rows = torch.from_numpy(spread_rows(np.arange(dataset.transitions), _LOGGED))
        seen = world.histories(rows.to(world.device))
        return cls(seen, judged.act_at(seen, lane_key(dataset.card.name, "judge", "logged")))

    @property
    def pairs(self) -> Tensor:
        """The newest frames with the actions, ``[Q, V, F + A]``."""
        newest = self.histories[:, 0].expand(len(self.actions), -1, -1)
        return torch.cat([newest, self.actions], dim=-1).cpu()

    def distances(self, behaviour: Policy) -> Tensor:
        """Mean distance to the behaviour policy, ``[Q]``."""
        apart = self.actions - behaviour.act(self.histories[None])
        distance: Tensor = torch.linalg.vector_norm(apart, dim=-1).mean(dim=1)
        return distance


def _fitted(
    dataset: OfflineDataset,
    world: VirtualWorld,
    judged: Sequence[JudgedPolicies],
    config: JudgeConfig,
    device: torch.device,
    names: Sequence[str],
    checkpoint: Path | None,
    progress: Callable[[float], None],
) -> Tensor:
    """Returns by fitted critics, ``[R, Q, B]``."""
    rows = torch.from_numpy(spread_rows(np.arange(dataset.transitions), config.transitions))
    rows, key = rows.to(device), lane_key(dataset.card.name, "fitted_q")
    with torch.no_grad():
        after = [_actions(judged, world.next_histories(part), key) for part in rows.split(_BLOCK)]
        first = _actions(judged, world.start_histories, lane_key(key, "start"))
    data = LaneData([dataset] * config.replicas, device)
    observations = data.observations(world.starts.expand(config.replicas, -1))
    return policy_values(
        data,
        rows,
        torch.cat(after, dim=1),
        (observations, first),
        config,
        key,
        names=[
            f"{name}#{q}" for name, one in zip(names, judged, strict=True) for q in range(one.count)
        ],
        checkpoint=checkpoint,
        progress=progress,
    ).cpu()


def _actions(judged: Sequence[JudgedPolicies], histories: Tensor, key: int) -> Tensor:
    """What all policies of all stacks do at the same observations ``[B, H, F]``: ``[Q, B, A]``."""
    return torch.cat([one.act_at(histories, key) for one in judged])


def _error(returns: Tensor) -> Tensor:
    """Standard error of the mean of ``[R, Q, B]`` over replicas and start states, ``[Q]``."""
    replicas, _, starts = returns.shape
    of_replicas = returns.mean(dim=2).var(dim=0, correction=min(1, replicas - 1)) / replicas
    of_starts = returns.mean(dim=0).var(dim=1, correction=min(1, starts - 1)) / starts
    return (of_replicas + of_starts).sqrt()


def _joined(parts: Sequence[Tensor]) -> NDArray[np.float64]:
    joined: NDArray[np.float64] = torch.cat([part.cpu() for part in parts]).double().numpy()
    return joined
