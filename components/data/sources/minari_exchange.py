"""Datasets to and from Minari (HDF5), so that other tools can load them.

A Minari episode holds T + 1 observations for T actions: observation t, action t, reward t and
observation t + 1 belong together, and the last observation is the one after the last action.
Tools that drop the `+ 1` shift every later episode; the tests check the alignment both ways.

Exported observations are single frames. The environment in the dataset's description is this
project's, made so that it has exactly these observations; `recover_environment()` works wherever
this package is installed. Where the benchmark's observation is a history, users stack the last
frames, newest first, repeating the episode's first frame where there are fewer (the description
says so), or export with `stacked=True`: the same transitions with whole histories (180 values on
the Industrial Benchmark), for tools that do not stack frames.

Minari names cannot hold dots: mediocre-0.2 becomes proximity/mediocre-0p2-v0.

An export carries its dataset's card, digest included, so it says by itself whether it is whole and
what it is of: exporting again changes nothing, mends what is damaged, and replaces what is another
dataset of the same name, such as one of another seed. The version in the id stays v0. A version
that counted contents would depend on the order in which they were exported.
"""

import contextlib
import itertools
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
from minari import EpisodeData
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from components.core.files import temporary_name
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset, array_digest
from components.data.history import gather_history
from components.environments.systems import SYSTEMS  # its package registers them with Gymnasium

__all__ = [
    "ForeignDatasetError",
    "export_minari",
    "import_minari",
    "minari_id",
    "minari_root",
    "remove_leftovers",
]

_NAMESPACE = "proximity"
_CARD_KEY = "proximity_dataset_card"
_ROOT_VARIABLE = "MINARI_DATASETS_PATH"
_SUFFIX = "-v0"


class ForeignDatasetError(ValueError):
    """A Minari dataset that another project has written."""


def minari_root() -> Path:
    """The folder in which Minari looks for datasets; Minari's own function would make it."""
    given = os.environ.get(_ROOT_VARIABLE)
    return Path(given) if given else Path.home() / ".minari" / "datasets"


def minari_id(name: str, *, stacked: bool = False) -> str:
    """Minari's id of a dataset, e.g. "proximity/mediocre-0p2-v0"."""
    return f"{_NAMESPACE}/{name.replace('.', 'p')}{'-stacked' if stacked else ''}{_SUFFIX}"


def export_minari(dataset: OfflineDataset, root: Path, *, stacked: bool = False) -> str:
    """Make sure that a dataset lies below a Minari root; it appears complete or not at all.

    An equal export stays as it is; another or a damaged one of the same id is replaced.

    Args:
        dataset: what to write.
        root: the folder that MINARI_DATASETS_PATH names when the dataset is loaded.
        stacked: store observations of all history frames instead of single frames.

    Returns:
        The dataset's Minari id.

    Raises:
        ValueError: a dataset of that id exists below the root which is not this project's.
    """
    card = dataset.card
    dataset_id = minari_id(card.name, stacked=stacked)
    root = Path(root).resolve()
    target = root / dataset_id
    if _is_exported(card, dataset_id, root):
        return dataset_id
    target.parent.mkdir(parents=True, exist_ok=True)
    history = card.history if stacked else 1
    with temporary_name(root / target.name) as temporary:
        temporary.mkdir()
        with _minari_root(temporary), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # optional fields that we leave out
            created = minari.create_dataset_from_buffers(
                dataset_id,
                list(_episodes(dataset, history)),
                **_system(card, history),
                algorithm_name=_controller(card),
                author="proximity-bench",
                description=_description(card, stacked),
                requirements=["proximity-bench"],
                data_format="hdf5",
            )
        created.storage.update_metadata({_CARD_KEY: card.to_json()})
        for file in (temporary / _NAMESPACE).glob("*.json"):
            os.replace(file, target.parent / file.name)
        _replace(temporary / dataset_id, target, temporary)
    return dataset_id


def remove_leftovers(root: Path) -> None:
    """Remove what killed exports have left below a Minari root; nobody may be exporting there."""
    for left in Path(root).glob(f".*{_SUFFIX}-????????????"):
        shutil.rmtree(left, ignore_errors=True)


def _is_exported(card: DatasetCard, dataset_id: str, root: Path) -> bool:
    """Whether the export of a dataset is there and whole.

    Raises:
        ValueError: another project's dataset has its place.
    """
    try:
        return import_minari(dataset_id, root).card.to_json() == card.to_json()
    except ForeignDatasetError:
        raise
    except (FileNotFoundError, ValueError):
        return False


def _replace(made: Path, target: Path, aside: Path) -> None:
    """Rename a folder, which another one may have the name of; that one is moved into `aside`."""
    for number in itertools.count():
        try:
            os.replace(made, target)
        except OSError:
            if not target.exists():
                raise
            # Another process may move it at the same moment: then there is nothing to move.
            with contextlib.suppress(FileNotFoundError):
                os.replace(target, aside / f"former{number}")
        else:
            return


def import_minari(dataset_id: str, root: Path) -> OfflineDataset:
    """Read a dataset that `export_minari` wrote, single frames or stacked.

    Args:
        dataset_id: Minari's id.
        root: the folder below which it lies.

    Raises:
        FileNotFoundError: no such dataset below the root.
        ValueError: a dataset without this project's card, whose content does not have the digest
            on its card, or with a value that cannot be, see :mod:`components.data.validity`.
    """
    folder = Path(root) / dataset_id / "data"
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no Minari dataset {dataset_id!r} below {root}.")
    try:
        source = minari.MinariDataset(folder)
        text, total_steps = source.storage.metadata.get(_CARD_KEY), source.total_steps
        episodes = list(source.iterate_episodes()) if isinstance(text, str) else []
    except Exception as error:  # Minari and HDF5 raise whatever they stumble over
        raise ValueError(f"{dataset_id} is damaged ({error}); export it again.") from error
    if not isinstance(text, str):
        raise ForeignDatasetError(
            f"{dataset_id} was not exported by this project: it has no dataset card; "
            "export to another folder, or read it with flows.import_log."
        )
    if not episodes:
        raise ValueError(f"{dataset_id} is damaged (it has no episode); export it again.")
    card = DatasetCard.from_json(text, f"the card of {dataset_id}")
    arrays = _arrays(dataset_id, episodes, len(card.frame_features))
    if total_steps != len(arrays["rewards"]):
        raise ValueError(
            f"{dataset_id} has {len(arrays['rewards'])} transitions, but Minari's metadata say "
            f"{total_steps}; export it again."
        )
    if array_digest(arrays) != card.digest:
        raise ValueError(
            f"the content of {dataset_id} does not have the digest on its card; it was changed "
            "after it was exported, so export it again."
        )
    imported = OfflineDataset(card=card, **arrays)
    imported.check(dataset_id)
    return imported


def _arrays(
    dataset_id: str, episodes: Sequence[EpisodeData], features: int
) -> dict[str, NDArray[Any]]:
    """The arrays of a log whose frames have so many features."""
    frames, actions, rewards, terminated, truncated, lengths = [], [], [], [], [], []
    for episode in episodes:
        observations = np.asarray(episode.observations)
        if len(observations) != len(episode.actions) + 1:
            raise ValueError(
                f"episode {episode.id} of {dataset_id} has {len(observations)} observations for "
                f"{len(episode.actions)} actions; there must be one more than actions."
            )
        frames.append(observations[:, :features])  # the newest frame comes first in a stack
        actions.append(episode.actions)
        rewards.append(episode.rewards)
        terminated.append(episode.terminations)
        truncated.append(episode.truncations)
        lengths.append(len(episode.actions))
    return {
        "frames": np.concatenate(frames).astype(np.float32),
        "actions": np.concatenate(actions).astype(np.float32),
        "rewards": np.concatenate(rewards).astype(np.float32),
        "terminated": np.concatenate(terminated).astype(np.bool_),
        "truncated": np.concatenate(truncated).astype(np.bool_),
        "episode_starts": np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
    }


def _episodes(dataset: OfflineDataset, history: int) -> Iterator[EpisodeBuffer]:
    starts = dataset.episode_starts
    for episode in range(dataset.episodes):
        begin, end = int(starts[episode]), int(starts[episode + 1])
        rows = np.arange(begin + episode, end + episode + 1)  # one more than transitions
        observations = gather_history(dataset.frames, rows, np.full_like(rows, rows[0]), history)
        yield EpisodeBuffer(
            id=episode,
            seed=None,
            observations=np.asarray(observations),
            actions=np.asarray(dataset.actions[begin:end]),
            rewards=np.asarray(dataset.rewards[begin:end]),
            terminations=np.asarray(dataset.terminated[begin:end]),
            truncations=np.asarray(dataset.truncated[begin:end]),
        )


def _system(card: DatasetCard, history: int) -> dict[str, Any]:
    """Minari's arguments for the system of a log: its environment, or the spaces if it has none."""
    if card.environment not in SYSTEMS:
        width, actions = history * len(card.frame_features), len(card.action_features)
        return {
            "observation_space": gym.spaces.Box(-np.inf, np.inf, (width,), np.float32),
            "action_space": gym.spaces.Box(-1.0, 1.0, (actions,), np.float32),
        }
    parameters = dict(card.environment_parameters)
    if card.history > 1:  # systems that are observed frame by frame have no such parameter
        parameters["history"] = history
    environment = gym.make(card.environment, max_episode_steps=card.steps, **parameters)
    try:
        return {"env": environment.spec}
    finally:
        environment.close()


def _controller(card: DatasetCard) -> str:
    noise = f" and Gaussian noise of {card.noise:g} on its own" if card.noise else ""
    return f"{card.controller} controller with {card.epsilon:.0%} random actions{noise}"


def _description(card: DatasetCard, stacked: bool) -> str:
    width = len(card.frame_features)
    frame = ", ".join(card.frame_features)
    if stacked:
        what = (
            f"An observation is the last {card.history} frames of {width} values ({frame}), newest "
            "first, flattened frame by frame."
        )
    else:
        what = f"An observation is one frame of {width} values ({frame})."
    if card.history > 1 and not stacked:
        what += (
            f" The benchmark's observation is the last {card.history} frames, newest first, with "
            "the episode's first frame in the place of missing ones."
        )
    weights: Mapping[str, float] = card.dynamics.get("reward", {})
    reward = "the system's own"
    if weights and set(weights) <= set(card.frame_features):
        terms = " + ".join(f"({weight:g}) {name}" for name, weight in weights.items())
        reward = f"{terms} of the frame after the action"
    return (
        f"{card.name}: {card.environment} at {dict(card.environment_parameters)}, logged by the "
        f"{_controller(card)}. {what} An action holds {', '.join(card.action_features)}, each in "
        f"[-1, 1]. The reward is {reward}. An episode that is truncated was cut by time, which is "
        "no terminal state."
    )


@contextlib.contextmanager
def _minari_root(folder: Path) -> Iterator[None]:
    """Set Minari's root within the block; Minari reads it from the environment at every call."""
    before = os.environ.get(_ROOT_VARIABLE)
    os.environ[_ROOT_VARIABLE] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[_ROOT_VARIABLE]
        else:
            os.environ[_ROOT_VARIABLE] = before
