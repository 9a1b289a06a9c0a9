"""Costs of nodes grow with what their work grows with, and are no part of keys."""

from dataclasses import replace
from pathlib import Path

import pytest

from components.algorithms import ALGORITHMS
from components.data.dataset import OfflineDataset
from components.data.sizes import DataSizes, relative_work, weights
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.source import generate
from components.data.sources.stored_log import StoredLog
from components.models import MODELS
from flows.pipeline.plan import Node
from flows.planning.costs import data_cost, data_sizes, evaluation_cost


def test_sizes_are_those_of_the_data_that_will_be_made(tmp_path: Path) -> None:
    spec = IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=3, steps=40)
    made = generate(spec, seed=0)
    made.write(tmp_path / "log")
    expected = DataSizes(30, 6, 3, 120)
    assert data_sizes(spec) == expected
    assert data_sizes(StoredLog("mine", str(tmp_path / "log"))) == expected
    assert expected.observation == 180
    assert OfflineDataset.open(tmp_path / "log").transitions == expected.transitions
    assert data_sizes(RobotSpec("hopper", "hopper")) == DataSizes(1, 11, 3, 1_000_000)


def test_weights_count_every_network_of_a_configuration() -> None:
    config = ALGORITHMS["bcq"].config(hidden=(4, 5), vae_hidden=(6,))
    sizes = DataSizes(history=2, frame=5, action=3)
    assert weights(config, sizes) == 10 * 4 + 4 * 5 + 5 * 3 + 10 * 6 + 6 * 3
    assert relative_work(type(config)(), DataSizes()) == 1.0
    assert relative_work(ALGORITHMS["wsbc"].config(), sizes) == 1.0  # it has none of its own


def test_robots_networks_and_logs_count() -> None:
    robot, usual = data_sizes(RobotSpec("hopper", "hopper")), DataSizes()
    learner = ALGORITHMS["td3_bc"]
    config = learner.config()
    narrower = (11 * 256 + 256 * 256 + 256 * 3) / (180 * 256 + 256 * 256 + 256 * 3)
    ratio = learner.cost(config, robot) / learner.cost(config, usual)
    assert ratio == pytest.approx(0.25 + 0.75 * narrower)
    for name, kind in MODELS.items():
        fit = kind.config()
        longer = kind.cost(fit, replace(usual, transitions=10 * usual.transitions))
        # epochs are passes over the log, updates of the recurrent ensemble are not
        times = 1.0 if name == "recurrent_ensemble" else 10.0
        assert longer == pytest.approx(times * kind.cost(fit, usual)), name
    assert data_cost(RobotSpec("hopper", "hopper")) > data_cost(IndustrialSpec("a", "bad", 0.2))


def test_policies_that_choose_among_candidates_are_dear_to_evaluate() -> None:
    plain, choosing = ALGORITHMS["ddpg"].config(), ALGORITHMS["bcq"].config()
    sizes, states = DataSizes(), 20_000
    one = evaluation_cost(plain, sizes, states, robot=False)
    assert evaluation_cost(choosing, sizes, states, robot=False) > 50 * one
    assert evaluation_cost(plain, sizes, states, robot=True) > one


def test_costs_are_no_part_of_keys() -> None:
    node = Node("toys", "a", "tasks:make", 1, {"number": 1}, cost=1.0)
    assert replace(node, cost=1000.0).key == node.key
