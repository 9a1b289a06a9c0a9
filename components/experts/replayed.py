"""The updates of online training, on transitions drawn uniformly from a replay memory."""

from collections.abc import Sequence

import torch
from torch import Tensor

from components.algorithms import ddpg
from components.algorithms.parts.twin_delayed import TwinDelayed, TwinDelayedConfig
from components.core.draws import Normal, UniformDouble
from components.core.random_streams import LaneStreams
from components.data.batches import Batch
from components.experts.config import ExpertConfig
from components.experts.replay import Replay

__all__ = ["ReplayedDDPG", "ReplayedTD3", "replayed_learner"]


def _drawn(replay: Replay, row: Tensor) -> Batch:
    return replay.batch((row * replay.filled).long())


class ReplayedDDPG(ddpg.ActorCritic):
    """DDPG on what was collected so far.

    Args:
        config: Settings.
        keys: One random stream per lane.
        replay: The memory.
        widths: Of an observation and of an action.
        device: Where to learn.
    """

    updates_per_graph = 1

    def __init__(
        self,
        config: ddpg.Config,
        keys: Sequence[int],
        replay: Replay,
        widths: tuple[int, int],
        device: torch.device,
    ) -> None:
        super().__init__(config, keys, *widths, device)
        self._replay = replay
        self._streams = LaneStreams(keys, {"row": UniformDouble(config.batch)}, device)

    def update(self, step: int) -> dict[str, Tensor]:
        """One update on transitions drawn uniformly from all that there are."""
        return self.learn(_drawn(self._replay, self._streams.at(step)["row"]))


class ReplayedTD3(TwinDelayed):
    """TD3 on what was collected so far; arguments as of :class:`ReplayedDDPG`."""

    updates_per_graph = 1

    def __init__(
        self,
        config: TwinDelayedConfig,
        keys: Sequence[int],
        replay: Replay,
        widths: tuple[int, int],
        device: torch.device,
    ) -> None:
        super().__init__(config, keys, *widths, device)
        self._replay = replay
        draws = {"row": UniformDouble(config.batch), "noise": Normal(config.batch, widths[1])}
        self._streams = LaneStreams(keys, draws, device)

    def update(self, step: int) -> dict[str, Tensor]:
        """One update on transitions drawn uniformly from all that there are."""
        drawn = self._streams.at(step)
        return self.learn(step, _drawn(self._replay, drawn["row"]), drawn["noise"])


def replayed_learner(
    config: ExpertConfig,
    keys: Sequence[int],
    replay: Replay,
    widths: tuple[int, int],
    device: torch.device,
) -> ReplayedDDPG | ReplayedTD3:
    """The learner of a training's method; arguments as of :class:`ReplayedDDPG`."""
    settings = config.learner
    if isinstance(settings, TwinDelayedConfig):
        return ReplayedTD3(settings, keys, replay, widths, device)
    return ReplayedDDPG(settings, keys, replay, widths, device)
