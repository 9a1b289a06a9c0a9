"""Exchange with Minari: alignment, names, other tools' view, and the way back."""

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest

from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.minari_exchange import (
    export_minari,
    import_minari,
    minari_id,
    remove_leftovers,
)
from components.data.sources.robots import RobotSpec
from components.data.sources.source import generate
from components.environments.mujoco.specifications import SWIMMER
from tests.components.data.sources.toy_robot import toy_expert
from tests.components.synthetic import make_log, relabelled


@pytest.fixture(scope="module")
def dataset() -> OfflineDataset:
    return generate(
        IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=3, steps=40), seed=0
    )


@pytest.fixture
def swimmer(monkeypatch: pytest.MonkeyPatch) -> OfflineDataset:
    """Two short episodes and a cut one, by an untrained controller."""
    expert = toy_expert(features=SWIMMER.frame_features)
    monkeypatch.setattr(RobotSpec, "_expert", lambda spec: expert)
    return RobotSpec("swimmer", "swimmer", transitions=50, steps=20).generate(0)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def test_names_hold_no_dots() -> None:
    assert minari_id("mediocre-0.2") == "proximity/mediocre-0p2-v0"
    assert minari_id("bad-0.0", stacked=True) == "proximity/bad-0p0-stacked-v0"


def test_another_tool_finds_aligned_episodes(dataset: OfflineDataset, root: Path) -> None:
    name = export_minari(dataset, root)
    assert list(minari.list_local_datasets()) == [name]
    loaded = minari.load_dataset(name)
    assert loaded.total_episodes == 3
    assert loaded.total_steps == 120
    for index, episode in enumerate(loaded.iterate_episodes()):
        first, action = 41 * index, 40 * index
        assert episode.observations.shape == (41, 6)
        assert episode.actions.shape == (40, 3)
        np.testing.assert_array_equal(episode.observations, dataset.frames[first : first + 41])
        np.testing.assert_array_equal(episode.actions, dataset.actions[action : action + 40])
        np.testing.assert_array_equal(episode.rewards, dataset.rewards[action : action + 40])
        assert episode.truncations.tolist() == [False] * 39 + [True]
        assert not episode.terminations.any()
        # physics, not bookkeeping: action t leads from observation t to observation t + 1
        sizes = np.array([1.0, 10.0, 5.7515])
        moved = np.clip(episode.observations[:-1, 1:4] + sizes * episode.actions, 0.0, 100.0)
        # float32 near 100, and a shift step given with five digits
        np.testing.assert_allclose(episode.observations[1:, 1:4], moved, atol=1e-4)
        costs = 3.0 * episode.observations[1:, 4] + episode.observations[1:, 5]
        np.testing.assert_allclose(episode.rewards, -costs / 100.0, rtol=1e-5)  # float32


@pytest.mark.filterwarnings("ignore:Package proximity-bench")
def test_environment_is_recovered_with_the_datasets_spaces(
    dataset: OfflineDataset, root: Path
) -> None:
    for stacked in (False, True):
        loaded = minari.load_dataset(export_minari(dataset, root, stacked=stacked))
        environment = loaded.recover_environment()
        assert environment.observation_space == loaded.observation_space
        assert environment.action_space == loaded.action_space
        observation, _ = environment.reset(seed=0)
        assert observation[0] == 70.0
        assert all(
            loaded.observation_space.contains(observation) for observation in loaded[0].observations
        )


@pytest.mark.parametrize("stacked", [False, True])
def test_round_trip(dataset: OfflineDataset, root: Path, stacked: bool) -> None:
    imported = import_minari(export_minari(dataset, root, stacked=stacked), root)
    assert imported.card == dataset.card
    for name, array in dataset.arrays().items():
        returned = imported.arrays()[name]
        assert returned.dtype == array.dtype
        np.testing.assert_array_equal(returned, array)


@pytest.mark.filterwarnings("ignore:Package proximity-bench")
@pytest.mark.parametrize("stacked", [False, True])
def test_robots_go_there_and_back(swimmer: OfflineDataset, root: Path, stacked: bool) -> None:
    name = export_minari(swimmer, root, stacked=stacked)
    loaded = minari.load_dataset(name)
    assert [len(episode.actions) for episode in loaded.iterate_episodes()] == [20, 20, 10]
    np.testing.assert_array_equal(loaded[1].observations, swimmer.frames[21:42])
    environment = loaded.recover_environment()
    assert environment.spec.kwargs == {"physics": "v3"}
    assert environment.observation_space == loaded.observation_space
    assert loaded.observation_space.contains(loaded[0].observations[3])
    imported = import_minari(name, root)
    assert imported.card == swimmer.card
    for array, values in swimmer.arrays().items():
        np.testing.assert_array_equal(imported.arrays()[array], values)


def test_falls_go_there_and_back(dataset: OfflineDataset, root: Path) -> None:
    terminated = dataset.terminated.copy()
    terminated[39] = True
    fallen = relabelled(dataset, terminated=terminated, truncated=dataset.truncated & ~terminated)
    name = export_minari(fallen, root)
    loaded = minari.load_dataset(name)
    assert [bool(loaded[n].terminations[-1]) for n in range(3)] == [True, False, False]
    assert [bool(loaded[n].truncations[-1]) for n in range(3)] == [False, True, True]
    np.testing.assert_array_equal(import_minari(name, root).terminated, terminated)


def test_the_description_says_how_the_data_were_made(
    dataset: OfflineDataset, swimmer: OfflineDataset, root: Path
) -> None:
    for log, words in (
        (dataset, ("mediocre controller with 20% random actions.", "last 30 frames", "-0.03) fat")),
        (swimmer, ("30% random actions and Gaussian noise of 0.3", "is the system's own")),
    ):
        name = export_minari(log, root)
        text = minari.load_dataset(name).storage.metadata["description"]
        assert all(word in text for word in words)


def test_stacked_observations_are_newest_first(dataset: OfflineDataset, root: Path) -> None:
    loaded = minari.load_dataset(export_minari(dataset, root, stacked=True))
    observations = loaded[1].observations.reshape(41, 30, 6)
    for step, lag, row in ((0, 0, 0), (0, 29, 0), (5, 2, 3), (5, 7, 0), (40, 29, 11)):
        np.testing.assert_array_equal(observations[step, lag], dataset.frames[41 + row])


def test_export_leaves_the_environment_variable_and_no_litter(
    dataset: OfflineDataset, root: Path, tmp_path: Path
) -> None:
    before = os.environ["MINARI_DATASETS_PATH"]
    other = tmp_path / "other"
    export_minari(dataset, other)
    assert os.environ["MINARI_DATASETS_PATH"] == before
    assert [path.name for path in other.iterdir()] == ["proximity"]
    export_minari(dataset, other)
    assert [path.name for path in other.iterdir()] == ["proximity"]


def times(root: Path, name: str) -> dict[str, int]:
    """When each file of an export was written."""
    files = [path for path in (root / name).rglob("*") if path.is_file()]
    return {path.name: path.stat().st_mtime_ns for path in files}


def test_an_equal_export_stays_as_it_is(dataset: OfflineDataset, root: Path) -> None:
    name = export_minari(dataset, root)
    before = times(root, name)
    assert export_minari(dataset, root) == name
    assert times(root, name) == before


def test_other_content_of_the_name_replaces_an_export(dataset: OfflineDataset, root: Path) -> None:
    name = export_minari(dataset, root)
    other = relabelled(dataset, rewards=dataset.rewards + 1.0)
    assert export_minari(other, root) == name
    assert import_minari(name, root).card == other.card
    assert export_minari(dataset, root) == name
    assert import_minari(name, root).card == dataset.card
    assert sorted(path.name for path in (root / name).parent.iterdir()) == [
        "mediocre-0p2-v0",
        "namespace_metadata.json",
    ]
    assert [path.name for path in root.iterdir()] == ["proximity"]


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-700])


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    place = content.find(np.float32(70.0).tobytes())
    content[place] ^= 4
    file.write_bytes(content)


def recount(file: Path) -> None:
    values = json.loads(file.read_text())
    file.write_text(json.dumps({**values, "total_steps": 119}))


@pytest.mark.parametrize(
    ("file", "harm"),
    [
        ("main_data.hdf5", truncate),
        ("main_data.hdf5", flip),
        ("main_data.hdf5", Path.unlink),
        ("metadata.json", truncate),
        ("metadata.json", Path.unlink),
        ("metadata.json", recount),
    ],
)
def test_a_damaged_export_is_made_again(
    file: str, harm: Callable[[Path], None], dataset: OfflineDataset, root: Path
) -> None:
    name = export_minari(dataset, root)
    harm(root / name / "data" / file)
    with pytest.raises(ValueError, match=rf"{name}.*export it again|the card of {name}"):
        import_minari(name, root)
    export_minari(dataset, root)
    assert import_minari(name, root).card == dataset.card


def test_a_dataset_of_another_project_is_not_replaced(dataset: OfflineDataset, root: Path) -> None:
    name = export_minari(dataset, root)
    metadata = root / name / "data" / "metadata.json"
    values = json.loads(metadata.read_text())
    del values["proximity_dataset_card"]
    metadata.write_text(json.dumps(values))
    with pytest.raises(ValueError, match="was not exported by this project"):
        export_minari(dataset, root)
    assert json.loads(metadata.read_text()) == values


@pytest.mark.parametrize("same", [True, False])
def test_two_exports_at_once_both_succeed(
    same: bool, dataset: OfflineDataset, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second runs from start to end while the first one is writing."""
    other = relabelled(dataset, rewards=dataset.rewards + 1.0)
    if not same:
        card = dataclasses.replace(other.card, name="bad-0.4")
        other = dataclasses.replace(other, card=card)
    create = minari.create_dataset_from_buffers

    def slow(*arguments: Any, **options: Any) -> Any:
        monkeypatch.setattr(minari, "create_dataset_from_buffers", create)
        export_minari(other, root)
        return create(*arguments, **options)

    monkeypatch.setattr(minari, "create_dataset_from_buffers", slow)
    name = export_minari(dataset, root)
    assert import_minari(name, root).card == dataset.card
    if not same:
        assert import_minari(minari_id("bad-0.4"), root).card == other.card
    assert [path.name for path in root.iterdir()] == ["proximity"]


def test_leftovers_of_killed_exports_are_removed(
    dataset: OfflineDataset, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = export_minari(dataset, root)
    (root / name).rename(root / ".mediocre-0p2-v0-0123456789ab")  # moved aside, then killed
    remove_leftovers(root)
    assert [path.name for path in root.iterdir()] == ["proximity"]
    export_minari(dataset, root)
    assert import_minari(name, root).card == dataset.card


def test_import_refuses_what_it_cannot_trust(dataset: OfflineDataset, root: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no Minari dataset"):
        import_minari("proximity/none-v0", root)
    name = export_minari(dataset, root)
    metadata = root / name / "data" / "metadata.json"
    values = json.loads(metadata.read_text())
    card = json.loads(values["proximity_dataset_card"])
    card["digest"] = "0" * 64
    metadata.write_text(json.dumps({**values, "proximity_dataset_card": json.dumps(card)}))
    with pytest.raises(ValueError, match="digest on its card"):
        import_minari(name, root)
    del values["proximity_dataset_card"]
    metadata.write_text(json.dumps(values))
    with pytest.raises(ValueError, match="no dataset card"):
        import_minari(name, root)


def test_a_log_without_a_known_system_comes_with_its_spaces(tmp_path: Path) -> None:
    log = make_log()
    card = dataclasses.replace(log.card, name="plant", environment="a plant", dynamics={})
    log = dataclasses.replace(log, card=card)
    written = minari.MinariDataset(tmp_path / export_minari(log, tmp_path) / "data")
    assert written.observation_space.shape == (6,)
    assert written.action_space.shape == (3,)
    again = import_minari(minari_id("plant"), tmp_path)
    assert again.card == card
    np.testing.assert_array_equal(again.frames, log.frames)
