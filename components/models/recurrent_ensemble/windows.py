"""Windows of model frames, from which the recurrent transition ensemble learns.

A window holds G + F steps and never crosses trajectories. A trajectory that ends in a terminal
state is continued in it (:mod:`components.data.absorbing_states`), so that the networks learn falls
from states and rewards, as in the thesis; a trajectory too short for a single window is left out.

Where a dataset's observations are histories, the first ones of a trajectory are padded with its
first frame, so virtual trajectories that start there initialise the ensemble with frames that were
never recorded. Training windows therefore also begin up to G steps before a trajectory, in its
first frame repeated; the held-out windows, on which fits are compared, hold recorded frames alone.
"""

import numpy as np
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.data.absorbing_states import with_absorbing_states
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification, model_frames
from components.data.history import Rows
from components.data.splits import EpisodeSplit, split_episodes
from components.models.recurrent_ensemble.ensemble import Feedback, RecurrentEnsembleConfig

__all__ = ["TrainingWindows"]


class TrainingWindows:
    """Windows of normalised model frames, gathered on the device for every network.

    Args:
        dataset: A log whose card has a dynamics specification.
        config: Members, groups, lengths of a window and share held out.
        device: Where windows are gathered.

    Attributes:
        names: Learned features, D of them.
        known: Number of known features of a model frame.
        groups: Names of the groups; a group's networks predict the same features.
        networks: M, networks of all groups.
        outputs: O, features that a network predicts.
        feedback: Which predictions of a group are read back, and which are changes.
        normaliser: Scaling of model frames, of the training trajectories.
        low: Smallest normalised targets of the training trajectories, ``[D]``.
        high: Largest.
        train: Rows in which windows of the training trajectories begin.
        held_out: Rows in which windows of the held-out trajectories begin.

    Raises:
        ValueError: If all trajectories on either side of the split are too short for a window.
    """

    def __init__(
        self, dataset: OfflineDataset, config: RecurrentEnsembleConfig, device: torch.device
    ) -> None:
        dynamics = DynamicsSpecification.of_card(dataset.card)
        self.names, self.known = dynamics.learned, len(dynamics.known)
        self.feedback = Feedback.of(config, dynamics).to(device)
        groups = len(self.feedback.reads)
        self.groups = dynamics.learned if groups == len(dynamics.learned) else ("joint",)
        self.outputs, self.networks = len(dynamics.learned) // groups, groups * config.members
        split = split_episodes(dataset, config.holdout)
        logged = split.trained_transitions(dataset)
        seen = np.array(model_frames(dataset, dynamics)[: split.trained_frames(dataset)])
        self.normaliser = Normaliser.fit(seen)
        targets = self.normaliser.apply(torch.from_numpy(seen))[:, self.known :]
        self.low, self.high = targets.amin(dim=0), targets.amax(dim=0)
        rows = dataset.frame_rows()[:logged]
        changes = Normaliser.fit((targets[rows + 1] - targets[rows]).numpy()).to(device)
        self._unit, self._offset = self._units(changes, config.hidden)
        # The first predicted step of a window is a logged one; all after it may be absorbing.
        whole = with_absorbing_states(dataset, config.horizon - 1)
        padding = config.warm_up if dataset.card.history > 1 else 0
        self.train, self.held_out = (
            torch.from_numpy(starts).to(device)
            for starts in _starts(whole, split, config.warm_up + config.horizon, padding)
        )
        frames = model_frames(whole, dynamics)[_padded(whole, padding)]
        scaled = self.normaliser.apply(torch.from_numpy(frames))
        self._table = scaled.T.contiguous().to(device)  # [features, rows]
        self._horizon, count = config.horizon, self._table.shape[1]
        steps = torch.arange(config.warm_up + config.horizon, device=device)
        self._steps = steps.view(-1, 1, 1, 1)
        self._known = torch.arange(self.known, device=device).view(1, 1, -1, 1) * count
        feature = self.known + torch.arange(len(dynamics.learned), device=device)
        target = self._of_networks(feature) * count
        self._own = target[None, :, : self.reads.shape[1], None]
        self._reads = self.reads[None, :, :, None]
        self._targets = target[:, :, None]

    def _units(self, changes: Normaliser, hidden: int) -> tuple[Tensor, Tensor]:
        """What :meth:`in_units` multiplies by and adds: ``[M, O, 1]`` and ``[M, O, H + 1]``."""
        adds = torch.zeros(len(self.groups), self.outputs, device=changes.mean.device)
        adds[:, : self.feedback.adds.shape[1]] = self.feedback.adds
        changing = adds.flatten().bool()
        unit = self._of_networks(torch.where(changing, changes.scale, 1.0))
        mean = self._of_networks(torch.where(changing, changes.mean, 0.0))
        return unit[:, :, None], torch.nn.functional.pad(mean[:, :, None], (hidden, 0))

    def _of_networks(self, values: Tensor) -> Tensor:
        """Values of the learned features ``[D]``, arranged by network: ``[M, O]``."""
        by_group = values.view(len(self.groups), -1)
        return by_group.repeat_interleave(self.networks // len(self.groups), dim=0)

    @property
    def reads(self) -> Tensor:
        """Whether a network reads each of its own values back, ``[M, D']``."""
        reads = self.feedback.reads.bool()
        return reads.repeat_interleave(self.networks // len(reads), dim=0)

    def in_units(self, readout: Tensor) -> Tensor:
        """Layers ``[M, O, H + 1]`` in normalised units from those in units of what is predicted."""
        return readout * self._unit + self._offset

    def gather(self, start: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs ``[G + F, M, known + D', B]``, targets ``[F, M * O, B]`` of ``start [M, B]``."""
        rows = start[None, :, None, :] + self._steps  # [T, M, 1, B]
        known = torch.take(self._table, rows + 1 + self._known)
        own = torch.take(self._table, rows + self._own) * self._reads
        future = rows[-self._horizon :] + 1
        targets = torch.take(self._table, future + self._targets)
        return torch.cat([known, own], dim=2), targets.flatten(1, 2)


def _padded(whole: OfflineDataset, padding: int) -> Rows:
    """Frame rows, with every trajectory's first one repeated ``padding`` times before it."""
    first = whole.episode_starts[:-1] + np.arange(whole.episodes)
    again = np.ones(len(whole.frames), np.int64)
    again[first] += padding
    rows: Rows = np.repeat(np.arange(len(again)), again)
    return rows


def _starts(
    whole: OfflineDataset, split: EpisodeSplit, length: int, padding: int
) -> tuple[Rows, Rows]:
    """Rows of :func:`_padded` in which windows of the training and held-out trajectories begin.

    Raises:
        ValueError: If all trajectories on either side are too short for a window.
    """
    # A trajectory's first transition row, plus a frame more and the padding of each before it.
    first = whole.episode_starts[:-1] + np.arange(whole.episodes) * (1 + padding) + padding
    count = np.diff(whole.episode_starts) - length + 1  # windows without padding
    found = []
    for episodes, before in ((split.train, padding), (split.held_out, 0)):
        if not any(count[e] > 0 for e in episodes):
            raise ValueError(
                f"Trajectory {episodes[0]} of {whole.card.name} is shorter than warm_up + horizon "
                f"= {length} steps, and so are the others that are to be "
                f"{'trained on' if episodes is split.train else 'held out'}; shorten these."
            )
        found.append(
            np.concatenate([np.arange(first[e] - before, first[e] + count[e]) for e in episodes])
        )
    train, held_out = found
    return train, held_out
