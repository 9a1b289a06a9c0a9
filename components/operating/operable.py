"""A policy with all that operating it takes, and its folder on the disk.

Some are shipped with the project (:data:`SHIPPED`), so that a fresh clone can turn the proximity
without training; `make shipped-policies` makes them again.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import torch

from components.core.files import replacing, replacing_folder, write_text
from components.core.tensors import load_tensors, save_tensors
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.data.neighbourhood import Neighbourhood
from components.data.splits import split_episodes
from components.policies.policy import Policy

__all__ = ["SHIPPED", "Operable", "familiar_frames", "is_packed", "newest", "packed_folders"]

SHIPPED: Final = Path(__file__).parent / "shipped"
"""Below it lies one folder per shipped policy."""

_BEHAVIOUR: Final = "behaviour"
_CARD: Final = "log.json"
_FAMILIAR: Final = "familiar.safetensors"
_POLICY: Final = ("policy.json", "weights.safetensors")  # what a policy writes into its folder
_OPTIONAL: Final = (_FAMILIAR, _BEHAVIOUR, *(f"{_BEHAVIOUR}/{name}" for name in _POLICY))
_NEIGHBOURS: Final = 2000  # frames that others are compared to
_QUANTILE: Final = 0.995  # of the log's held-out frames that counts as familiar


@dataclass(frozen=True, eq=False)
class Operable:
    """What is operated.

    Attributes:
        policy: A stack of one.
        behaviour: Clone of the log, a stack of one; None: none was fitted.
        card: Of the log that they learned from.
        familiar: The log's frames; None: not known.
        log: The log itself, where it is at hand.
    """

    policy: Policy
    behaviour: Policy | None
    card: DatasetCard
    familiar: Neighbourhood | None = None
    log: OfflineDataset | None = None

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all numbers that decide what the two policies do."""
        digest = hashlib.sha256()
        for policy in filter(None, (self.policy, self.behaviour)):
            for name, tensor in sorted(policy.tensors().items()):
                digest.update(f"{name} {tuple(tensor.shape)}\n".encode())
                digest.update(tensor.numpy().tobytes())
        return digest.hexdigest()

    def save(self, folder: Path, *, overwrite: bool = False) -> None:
        """Store all but the log in a folder, which appears complete or not at all.

        Args:
            folder: Its name.
            overwrite: Whether it may replace another one, which is there until then.

        Raises:
            OSError: It is there and holds something, or it cannot be written.
        """
        with (replacing_folder if overwrite else replacing)(folder) as made:
            made.mkdir(parents=True)
            self.policy.save(made)
            if self.behaviour is not None:
                (made / _BEHAVIOUR).mkdir()
                self.behaviour.save(made / _BEHAVIOUR)
            if self.familiar is not None:
                rows = torch.from_numpy(np.array(self.familiar.rows, np.float32))
                save_tensors(made / _FAMILIAR, {"rows": rows}, {"limit": self.familiar.limit})
            write_text(made / _CARD, self.card.to_json())

    @classmethod
    def load(cls, folder: Path) -> "Operable":
        """Read what :meth:`save` wrote.

        Raises:
            MissingFileError: A file is missing.
            DamagedFileError: A file is damaged.
        """
        behaviour = folder / _BEHAVIOUR
        familiar = None
        if (folder / _FAMILIAR).exists():
            tensors, header = load_tensors(folder / _FAMILIAR)
            familiar = Neighbourhood(tensors["rows"].numpy(), float(header["limit"]))
        return cls(
            newest(Policy.load(folder)),
            newest(Policy.load(behaviour)) if behaviour.exists() else None,
            DatasetCard.load(folder / _CARD),
            familiar,
        )


def packed_folders(parent: Path) -> dict[str, Path]:
    """Folders of packed policies in a folder, or the folder itself if it is one, by name."""
    # Hidden are those that are being written.
    found = sorted(p for p in parent.glob(f"*/{_CARD}") if not p.parent.name.startswith("."))
    return {path.parent.name: path.parent for path in found or parent.resolve().glob(_CARD)}


def is_packed(folder: Path) -> bool:
    """Whether a folder holds a packed policy, and nothing else that might be missed."""
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    return {*_POLICY, _CARD} <= found <= {*_POLICY, _CARD, *_OPTIONAL}


def newest(policy: Policy) -> Policy:
    """The last snapshot of a stack, as a stack of one."""
    card = replace(policy.card, steps=policy.card.steps[-1:])
    return policy.select(slice(policy.lanes - 1, policy.lanes), card)


def familiar_frames(log: OfflineDataset) -> Neighbourhood:
    """The neighbourhood of a log's frames, so wide that held-out ones lie within."""
    boundary = split_episodes(log).trained_frames(log) if log.episodes > 1 else len(log.frames) // 2
    near, held_out = (
        np.asarray(log.frames[part][:: max(1, size // _NEIGHBOURS)][:_NEIGHBOURS])
        for part, size in (
            (slice(None, boundary), boundary),
            (slice(boundary, None), len(log.frames) - boundary),
        )
    )
    return Neighbourhood.around(near, (held_out,), _QUANTILE)
