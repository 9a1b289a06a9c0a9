"""Minari datasets of others as tables: columns `observation_0` ..., `action_0` ..., `reward`.

An episode of T steps has T + 1 rows: the last holds the last observation alone. The column
`terminated` is 1 in the row of the last action where the episode ended for good, so schemas of
such tables have `outcome_row: same`. Observations and actions must be flat boxes.

Nothing is downloaded. A file whose HDF5 links lead to other files is refused unread.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pyarrow as pa
from gymnasium import spaces
from numpy.typing import NDArray

from components.data.imports.schema import LogError, LogSchema
from components.data.imports.tables import Batch, as_batch

__all__ = ["MinariTable"]


@dataclass(frozen=True)
class MinariTable:
    """A Minari dataset below a folder; its first row is row 1."""

    dataset_id: str
    root: Path

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return f"minari:{self.dataset_id}"

    @cached_property
    def folder(self) -> Path:
        """Where its files are.

        Raises:
            LogError: There is none, or one of its files would read another one.
        """
        folder = self.root / self.dataset_id / "data"
        if not folder.is_dir():
            raise LogError(
                f"{self.name}: there is no such dataset below {self.root}; `minari download "
                f"{self.dataset_id}` fetches one, and MINARI_DATASETS_PATH names another folder."
            )
        for file in sorted(folder.glob("*.hdf5")):
            _refuse_links(file, self.name)
        return folder

    @cached_property
    def _dataset(self) -> Any:
        folder = self.folder  # what is missing is not damaged
        try:
            return minari.MinariDataset(folder)
        except Exception as error:  # Minari and HDF5 raise whatever they stumble over
            raise LogError(f"{self.name} is damaged ({error}); download it again.") from error

    @cached_property
    def sizes(self) -> tuple[int, int]:
        """Numbers of values of an observation and of an action.

        Raises:
            LogError: They are no flat boxes.
        """
        observed = _flat(self._dataset.observation_space, f"{self.name}: observations")
        return observed, _flat(self._dataset.action_space, f"{self.name}: actions")

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Smallest and largest value of every action, by its space."""
        space = self._dataset.action_space
        return list(zip(space.low.tolist(), space.high.tolist(), strict=True))

    @property
    def columns(self) -> Sequence[str]:
        """Names of its columns."""
        observed, acted = self.sizes
        named = [f"observation_{n}" for n in range(observed)]
        named += [f"action_{n}" for n in range(acted)]
        return [*named, "reward", "terminated", "episode"]

    def batches(self, schema: LogSchema) -> Iterator[Batch]:
        """Its rows, an episode at a time."""
        row = 1
        for number in range(self._dataset.total_episodes):
            try:
                [episode] = self._dataset.iterate_episodes([number])
                values = self._columns(episode)
            except LogError:
                raise
            except Exception as error:
                raise LogError(
                    f"{self.name}, row {row}: episode {number} is damaged ({error}); download the "
                    "dataset again."
                ) from error
            columns = {name: pa.array(values[name]) for name in schema.columns}
            yield as_batch(self.name, row, columns, schema, opens=row == 1)
            row += len(values["reward"])

    def sample(self, rows: int) -> dict[str, Any]:
        """The first rows of its first episode."""
        self.sizes  # noqa: B018 -- refuses other spaces
        for episode in self._dataset.iterate_episodes([0]):
            return {
                name: pa.array(column[:rows]) for name, column in self._columns(episode).items()
            }
        return {}

    def _columns(self, episode: Any) -> dict[str, NDArray[Any]]:
        observations = np.asarray(episode.observations, np.float64)
        actions = np.asarray(episode.actions, np.float64)
        if len(observations) != len(actions) + 1:
            raise LogError(
                f"{self.name}: episode {episode.id} has {len(observations)} observations for "
                f"{len(actions)} actions; there must be one more than actions."
            )
        values: dict[str, NDArray[Any]] = {
            f"observation_{n}": column for n, column in enumerate(observations.T)
        }
        after = np.full((1, actions.shape[1]), np.nan)
        acted = np.concatenate([actions, after])
        values |= {f"action_{n}": column for n, column in enumerate(acted.T)}
        values["reward"] = np.append(np.asarray(episode.rewards, np.float64), np.nan)
        values["terminated"] = np.append(np.asarray(episode.terminations, np.float64), 0.0)
        values["episode"] = np.full(len(observations), int(episode.id))
        return values


def _flat(space: Any, what: str) -> int:
    """The number of values of a flat box."""
    if not isinstance(space, spaces.Box):
        kind = type(space).__name__
        raise LogError(f"{what} are of the kind {kind}; only flat boxes can be imported.")
    if len(space.shape) != 1:
        seems = "images" if len(space.shape) == 3 else "arrays"
        raise LogError(
            f"{what} are {seems} of the shape {space.shape}; only flat boxes can be imported."
        )
    return int(space.shape[0])


def _refuse_links(file: Path, name: str) -> None:
    """Refuse a file that would read another one."""
    outside: list[str] = []

    def look(path: str, link: Any) -> bool | None:
        if isinstance(link, h5py.ExternalLink):
            outside.append(f"{path!r} in {file.name} leads to {link.filename}")
            return True
        return None

    try:
        with h5py.File(file) as content:
            content.visititems_links(look)
    except OSError as error:
        raise LogError(f"{name}: {file.name} is damaged ({error}); download it again.") from error
    if outside:
        raise LogError(f"{name}: {outside[0]}; a file that reads others is not imported.")
