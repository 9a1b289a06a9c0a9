"""Logs that are stored already: what identifies them, and what is refused."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from components.data.dataset import OfflineDataset
from components.data.sources.stored_log import StoredLog
from components.environments.systems import INDUSTRIAL_BENCHMARK
from tests.components.synthetic import make_log, relabelled

LOG = make_log()


def stored(folder: Path, log: OfflineDataset = LOG) -> StoredLog:
    log.write(folder)
    return StoredLog("mine", str(folder))


def test_the_log_is_what_lies_there_under_its_own_name(tmp_path: Path) -> None:
    source = stored(tmp_path / "log")
    made = source.generate(7)
    assert made.card == dataclasses.replace(LOG.card, name="mine")
    for name, array in LOG.arrays().items():
        np.testing.assert_array_equal(made.arrays()[name], array)
    assert source.environment is None
    known = (source.discount, source.history, source.steps)
    assert known == (LOG.card.discount, LOG.card.history, LOG.card.steps)


def test_a_registered_system_on_its_card_is_its_system(tmp_path: Path) -> None:
    card = dataclasses.replace(
        LOG.card, environment=INDUSTRIAL_BENCHMARK.id, environment_parameters={"setpoint": 60.0}
    )
    source = stored(tmp_path / "log", dataclasses.replace(LOG, card=card))
    assert source.environment == INDUSTRIAL_BENCHMARK.id
    assert source.environment_parameters == {"setpoint": 60.0}


def test_its_content_identifies_it_and_its_place_does_not(tmp_path: Path) -> None:
    here, there = stored(tmp_path / "here"), stored(tmp_path / "there")
    assert (here.identity, here.ingredients) == (there.identity, there.ingredients)
    assert str(tmp_path) not in str(here.identity)
    other = stored(tmp_path / "rewards", relabelled(LOG, rewards=LOG.rewards + 1.0))
    assert other.ingredients["log"] != here.ingredients["log"]
    told = dataclasses.replace(LOG, card=dataclasses.replace(LOG.card, discount=0.5))
    other = stored(tmp_path / "card", told)
    assert other.ingredients["log"] == here.ingredients["log"]
    assert other.ingredients["card"] != here.ingredients["card"]


def cut(folder: Path) -> None:
    (folder / "rewards.npy").write_bytes(b"")


def change(folder: Path) -> None:
    rewards = np.load(folder / "rewards.npy")
    rewards[3] += 1.0
    np.save(folder / "rewards.npy", rewards)


@pytest.mark.parametrize(
    ("harm", "message"),
    [(cut, r"rewards\.npy is damaged"), (change, "do not have the digest on their card")],
)
def test_damaged_logs_are_refused(
    tmp_path: Path, harm: Callable[[Path], None], message: str
) -> None:
    source = stored(tmp_path / "log")
    harm(tmp_path / "log")
    with pytest.raises(ValueError, match=rf"{message}.* `log` in conf/dataset/mine\.yaml\.$"):
        source.generate(0)


def test_a_log_that_is_away_is_missed_only_when_it_is_asked_for(tmp_path: Path) -> None:
    source = StoredLog("mine", str(tmp_path / "nowhere"))
    assert source.identity["name"] == "mine"
    with pytest.raises(FileNotFoundError, match=r"There is no dataset in .*nowhere.*mine\.yaml"):
        _ = source.ingredients
