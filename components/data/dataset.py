"""An offline dataset: flat arrays with episode starts, and the card that says what they are.

Frames are stored once. With T_e transitions in episode e, the episode has T_e + 1 frames: the
first is the reset's, the last is the one after its last action. Transition i of episode e
therefore has its newest frame in row i + e and its next frame in row i + e + 1.

On disk a dataset is a folder of .npy files, opened memory-mapped, and `card.json`. The card holds
a digest of all arrays, checked when the folder is opened.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.core.files import replacing, write_text
from components.core.integrity import DamagedFileError, MissingFileError
from components.data.card import REMEDY, DatasetCard
from components.data.history import history_rows
from components.data.validity import check_card, check_log

__all__ = ["OfflineDataset", "array_digest"]

_CARD = "card.json"
_DTYPES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "frames": "<f4",
        "actions": "<f4",
        "rewards": "<f4",
        "terminated": "|b1",
        "truncated": "|b1",
        "episode_starts": "<i8",
    }
)


def array_digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """sha256 over name, type, shape and bytes of arrays, in the order of the folder's files."""
    digest = hashlib.sha256()
    for name in _DTYPES:
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


@dataclass(frozen=True, repr=False)
class OfflineDataset:
    """Logged transitions of E episodes, N transitions in all.

    Attributes:
        card: what the dataset is.
        frames: `[N + E, F]` float32.
        actions: `[N, A]` float32 in [-1, 1].
        rewards: `[N]` float32, of the state after the action.
        terminated: `[N]` bool, the state after the action is terminal.
        truncated: `[N]` bool, the episode was cut by time after the action; bootstrap through it.
        episode_starts: `[E + 1]` int64, first transition of each episode, and N.
    """

    card: DatasetCard
    frames: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    episode_starts: NDArray[np.int64]

    def __repr__(self) -> str:
        card = self.card
        return (
            f"OfflineDataset({card.name}: {self.transitions:,} transitions, episodes: "
            f"{self.episodes:,}, features: {', '.join(card.frame_features)}, actions: "
            f"{', '.join(card.action_features)})"
        )

    @property
    def transitions(self) -> int:
        """Number of transitions N."""
        return len(self.rewards)

    @property
    def episodes(self) -> int:
        """Number of episodes E."""
        return len(self.episode_starts) - 1

    def episode_index(self) -> NDArray[np.int64]:
        """`[N]` episode of each transition."""
        return np.repeat(np.arange(self.episodes, dtype=np.int64), np.diff(self.episode_starts))

    def frame_rows(self) -> NDArray[np.int64]:
        """`[N]` row of the newest frame of each transition; the next frame is one row later."""
        return np.arange(self.transitions, dtype=np.int64) + self.episode_index()

    def first_rows(self) -> NDArray[np.int64]:
        """`[N]` row of the first frame of each transition's episode."""
        starts = self.episode_starts[:-1] + np.arange(self.episodes, dtype=np.int64)
        return np.repeat(starts, np.diff(self.episode_starts))

    def spread_histories(self, number: int, frames: int) -> NDArray[np.float32]:
        """Recorded histories, evenly over the log.

        Args:
            number: Of histories; of a shorter log, all.
            frames: H, of each.

        Returns:
            `[number, H, F]`, the newest frame first.
        """
        chosen = np.linspace(0, self.transitions - 1, min(number, self.transitions)).astype(int)
        rows = history_rows(self.frame_rows()[chosen], self.first_rows()[chosen], frames)
        return np.asarray(self.frames[rows])

    def with_history(self, frames: int) -> "OfflineDataset":
        """The same log with observations of fewer frames; 0 leaves them as they are.

        Raises:
            ValueError: more frames than an observation has.
        """
        card = self.card
        if frames > card.history:
            raise ValueError(
                f"history is {frames}, but observations of {card.name} have {card.history} "
                "frames; give at most these."
            )
        return replace(self, card=replace(card, history=frames or card.history))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays by file name, in the order of the digest."""
        return {name: getattr(self, name) for name in _DTYPES}

    def check(self, source: object) -> None:
        """Refuse values that cannot be.

        Args:
            source: what the log is called in messages.

        Raises:
            ValueError: one sentence, see :mod:`components.data.validity`.
        """
        check_log(self.card, self.arrays(), source)

    def write(self, folder: Path) -> None:
        """Store the dataset; the folder appears complete or not at all.

        Args:
            folder: a new or empty folder.

        Raises:
            ValueError: the folder holds something already, or a value cannot be, see
                :mod:`components.data.validity`.
        """
        self.check(f"the log {self.card.name}")
        folder = Path(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"{folder} is not empty; remove it or write the dataset elsewhere.")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with replacing(folder) as temporary:
            temporary.mkdir()
            for name, array in self.arrays().items():
                np.save(temporary / f"{name}.npy", array, allow_pickle=False)
            write_text(temporary / _CARD, self.card.to_json())

    @classmethod
    def open(cls, folder: Path, *, check: bool = True) -> "OfflineDataset":
        """Open a stored dataset memory-mapped and read-only.

        Args:
            folder: what `write` was given.
            check: read all bytes, compare their digest with the card's, and check the values.

        Raises:
            MissingFileError: no dataset there, or one of its files is missing.
            DamagedFileError: a file that cannot be read, has another type or shape than it should,
                or does not have the digest on the card.
            ValueError: a value that cannot be, see :mod:`components.data.validity`.
        """
        folder = Path(folder)
        card = DatasetCard.load(folder / _CARD)
        arrays: dict[str, Any] = {}
        for name, dtype in _DTYPES.items():
            path = folder / f"{name}.npy"
            if not path.is_file():
                raise MissingFileError(f"{path} is missing from its dataset", path, REMEDY)
            try:
                arrays[name] = np.load(path, mmap_mode="r", allow_pickle=False)
            except (ValueError, EOFError, OSError) as error:
                said = f"{path} is damaged and cannot be read"
                raise DamagedFileError(said, path, REMEDY) from error
            if arrays[name].dtype != np.dtype(dtype):
                said = f"{path} holds {arrays[name].dtype}, not {dtype}"
                raise DamagedFileError(said, path, REMEDY)
        if check and array_digest(arrays) != card.digest:
            raise DamagedFileError(
                f"the arrays in {folder} do not have the digest on their card: they were changed "
                "or damaged after they were written",
                folder,
                REMEDY,
            )
        dataset = cls(card=card, **arrays)
        _check_shapes(dataset, folder)
        if check:
            dataset.check(f"the log in {folder}")
        else:
            check_card(card, f"the log in {folder}")
        return dataset


def _check_shapes(dataset: OfflineDataset, folder: Path) -> None:
    n, e = dataset.card.transitions, dataset.card.trajectories
    features, actions = len(dataset.card.frame_features), len(dataset.card.action_features)
    expected: dict[str, tuple[int, ...]] = {
        "frames": (n + e, features),
        "actions": (n, actions),
        "rewards": (n,),
        "terminated": (n,),
        "truncated": (n,),
        "episode_starts": (e + 1,),
    }
    for name, shape in expected.items():
        found = getattr(dataset, name).shape
        if found != shape:
            path = folder / f"{name}.npy"
            raise DamagedFileError(f"{path} has the shape {found}, not {shape}", path, REMEDY)
