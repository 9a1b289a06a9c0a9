"""Datasets of Minari: those of others with a schema, our own without one."""

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer

from components.data.dataset import OfflineDataset
from components.data.sources.minari_exchange import export_minari
from flows.import_log import import_log, load_import_settings, read_schema
from tests.components.synthetic import make_log
from tests.flows.furnace import furnace, imported


@pytest.fixture
def minari_folder(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(project / "minari"))
    return project / "minari"


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_minari_dataset_of_others_is_imported_with_a_schema(minari_folder: Path) -> None:
    environment = gym.make("Pendulum-v1")
    environment.action_space.seed(0)
    buffers = []
    for episode in range(4):
        buffer = EpisodeBuffer(id=episode, observations=[environment.reset(seed=episode)[0]])
        acted, rewards = [], []
        for _ in range(20):
            acted.append(environment.action_space.sample())
            seen, reward, *_ = environment.step(acted[-1])
            buffer.observations.append(seen)
            rewards.append(float(reward))
        ends = [False] * 19
        buffers.append(
            replace(
                buffer,
                observations=np.stack(buffer.observations),
                actions=np.stack(acted),
                rewards=rewards,
                terminations=[*ends, False],
                truncations=[*ends, True],
            )
        )
    made = minari.create_dataset_from_buffers(
        "other/pendulum-v0", buffers, env=environment.spec, data_format="hdf5"
    )
    words = ["minari:other/pendulum-v0", "name=furnace"]
    import_log(load_import_settings([*words, "--describe"]))
    described = read_schema(Path("furnace.yaml"))
    assert dict(described.actions) == {"action_0": (-2.0, 2.0)}
    assert described.same_row
    import_log(load_import_settings(words))
    log = OfflineDataset.open(Path("logs/furnace"))
    assert (log.episodes, log.transitions) == (4, 80)
    for n, episode in enumerate(made.iterate_episodes()):
        rows = slice(21 * n, 21 * (n + 1))
        np.testing.assert_array_equal(log.frames[rows], episode.observations.astype(np.float32))
        steps = slice(20 * n, 20 * (n + 1))
        np.testing.assert_array_equal(log.rewards[steps], episode.rewards.astype(np.float32))
        np.testing.assert_allclose(2 * log.actions[steps], episode.actions, atol=1e-6)
    assert log.card.action_bounds == ((-2.0, 2.0),)


def test_our_own_export_comes_back_exactly_and_needs_no_schema(minari_folder: Path) -> None:
    log = make_log()
    exported = export_minari(log, minari_folder)
    import_log(load_import_settings([f"minari:{exported}", "name=mine"]))
    back = OfflineDataset.open(Path("logs/mine"))
    assert back.card == log.card
    for name, array in log.arrays().items():
        np.testing.assert_array_equal(getattr(back, name), array)


def test_an_imported_dataset_comes_back_from_minari_with_its_bounds(minari_folder: Path) -> None:
    log = imported(furnace())
    exported = export_minari(log, minari_folder)
    import_log(load_import_settings([f"minari:{exported}", "name=again"]))
    assert OfflineDataset.open(Path("logs/again")).card == log.card
