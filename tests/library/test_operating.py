"""A policy at work, step by step, and the slider that turns its proximity."""

from dataclasses import replace

import numpy as np
import pytest

import proximity_bench as pb
from tests.components.synthetic import make_log
from tests.library.test_training import MODELS

LOG = pb.dataset("mediocre-0.2", trajectories=4, steps=110)
LION = pb.train(
    LOG,
    "lion",
    models={name: MODELS[name] for name in ("behaviour_policy", "recurrent_ensemble")},
    progress=False,
    updates=2,
    hidden=[8],
    trajectories=4,
    horizon=5,
)


def test_a_trajectory_is_what_evaluation_counts() -> None:
    found = pb.trajectory(LION, 0.5, steps=7)
    assert len(found) == 7
    assert list(found.columns) == [
        *LOG.card.frame_features,
        *(f"action {name}" for name in LOG.card.action_features),
        "reward",
    ]
    costs = 3 * found["fatigue"] + found["consumption"]
    np.testing.assert_allclose(found["reward"], -costs / 100, rtol=1e-9)
    moved = found["velocity"].diff().dropna().to_numpy()
    np.testing.assert_allclose(moved, found["action velocity"][1:], atol=1e-9)


def test_the_seed_alone_decides_the_systems_noise() -> None:
    assert pb.trajectory(LION, 0.5, steps=5).equals(pb.trajectory(LION, 0.5, steps=5))
    assert not pb.trajectory(LION, 0.5, steps=5, seed=1).equals(pb.trajectory(LION, 0.5, steps=5))
    first, second = (pb.trajectory(LION, value, steps=5) for value in (0.0, 1.0))
    assert not first["action gain"].equals(second["action gain"])


def test_playing_runs_the_machine_at_the_proximity_of_the_slider() -> None:
    dial, shown = pb.operate(LION, steps=4).children
    _, slider, _, play = dial.children
    begun = bytes(shown.value)
    assert begun.startswith(b"\x89PNG")
    play.value = 2
    familiar = bytes(shown.value)
    play.value = 0  # begins again
    assert bytes(shown.value) == begun
    slider.value = 0.75
    play.value = 2
    assert bytes(shown.value) not in (familiar, begun)


def test_what_cannot_be_operated_is_refused() -> None:
    with pytest.raises(ValueError, match="registered are"):
        pb.trajectory(replace(LION, log=make_log().card), 0.5)
    with pytest.raises(ValueError, match="at least 1"):
        pb.trajectory(LION, 0.5, steps=0)
    with pytest.raises(ValueError, match="needs proximity"):
        pb.trajectory(LION)
    fixed = pb.train(LOG, "bc", updates=2, hidden=[8], progress=False)
    with pytest.raises(ValueError, match="takes no proximity to be turned"):
        pb.operate(fixed)


def test_ranking_says_what_limits_a_log() -> None:
    other = pb.dataset("bad-0.4", trajectories=4, steps=110)
    table = pb.rank([LOG, other], progress=False)
    assert set(table["dataset"]) == {"mediocre-0.2", "bad-0.4"}
    assert sorted(table["coi_rank"]) == [0, 1]
    assert np.isfinite(table[["eri", "eas"]]).all(axis=None)
    assert table["limit"].str.startswith("Limited by").all()
    assert len(pb.rank(LOG, progress=False)) == 1
    with pytest.raises(ValueError, match="no logs"):
        pb.rank([])
