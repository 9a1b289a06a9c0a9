"""Policies of the library act on plain arrays: histories, units, proximities, refusals, storing."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

import proximity_bench as pb
from components.core.integrity import DamagedFileError
from components.core.normaliser import Normaliser
from components.policies.policy import Policy as StoredPolicy
from components.policies.policy import PolicyCard
from components.policies.portable_files import FORMATS
from proximity_bench.histories import FarFromLogWarning
from tests.components.robot import make_robot_log
from tests.components.synthetic import FEATURES, make_log

LOG, ROBOT = make_log(history=4), make_robot_log("robot")
BOUNDS = ((0.0, 100.0), (-5.0, 5.0), (10.0, 20.0))
FRAMES = LOG.frames[:9]


def made(algorithm: str = "lion", **card: Any) -> pb.Policy:
    """A random policy of two snapshots on the small machine's log."""
    generator = torch.Generator().manual_seed(3)
    takes = card.setdefault("takes_proximity", algorithm == "lion")
    stored = PolicyCard(
        algorithm=algorithm, dataset="toy", features=FEATURES, history=4, actions=3,
        steps=(5, 10), **card,
    )  # fmt: skip
    weight = 0.2 * torch.randn(2, 4 * 6 + takes, 3, generator=generator)
    own = Normaliser.fit(LOG.frames, 1e-3)
    frames = Normaliser(own.mean.expand(2, -1), own.scale.expand(2, -1))
    actor = {"actor": [(weight, torch.zeros(2, 1, 3))]}
    return pb.Policy(StoredPolicy.of_networks(stored, actor, frames), 7, LOG.card)


def test_it_acts_as_the_newest_stored_snapshot_on_the_newest_frames_first() -> None:
    policy = made()
    history = torch.tensor(FRAMES[-4:][::-1].copy())[None, None].expand(2, -1, -1, -1)
    expected = policy.stack.act(history, torch.full((2, 1), 0.3))
    action = policy.act(FRAMES, proximity=0.3)
    assert action.shape == (3,)
    np.testing.assert_allclose(action, expected[1, 0], atol=1e-6)  # summed in another order
    np.testing.assert_allclose(policy.at(5).act(FRAMES, 0.3), expected[0, 0], atol=1e-6)
    assert not np.allclose(expected[0], expected[1])


def test_the_first_frame_repeats_before_a_short_history() -> None:
    policy = made("bc")
    padded = np.concatenate([FRAMES[:1], FRAMES[:1], FRAMES[:2]])
    np.testing.assert_array_equal(policy.act(FRAMES[:2]), policy.act(padded))
    np.testing.assert_array_equal(policy.act(FRAMES[:1]), policy.act(np.repeat(FRAMES[:1], 4, 0)))
    np.testing.assert_array_equal(policy.act(FRAMES), policy.act(FRAMES[-4:]))


def test_many_machines_act_at_once_each_with_its_proximity() -> None:
    policy, many = made(), np.stack([FRAMES, FRAMES[::-1]])
    actions = policy.act(many, [0.1, 0.9])
    assert actions.shape == (2, 3)
    np.testing.assert_allclose(actions[0], policy.act(many[0], 0.1), atol=1e-6)
    np.testing.assert_allclose(actions[1], policy.act(many[1], 0.9), atol=1e-6)


def test_a_frame_of_pandas_gives_its_columns_by_name() -> None:
    policy = made("bc")
    rows = pd.DataFrame(FRAMES, columns=list(FEATURES))
    shuffled = rows[list(FEATURES[::-1])].assign(operator="Ann")
    np.testing.assert_array_equal(policy.act(shuffled), policy.act(FRAMES))
    with pytest.raises(ValueError, match=r"^The history lacks gain, shift; give the 6 values set"):
        policy.act(rows.drop(columns=["gain", "shift"]))


def test_actions_have_the_units_of_the_log_where_its_card_knows_them() -> None:
    policy = made("bc")
    plant = replace(policy, log=replace(LOG.card, action_bounds=BOUNDS))
    scaled = policy.act(FRAMES)
    np.testing.assert_array_equal(plant.act(FRAMES, scaled=True), scaled)
    low, high = np.array(BOUNDS).T
    np.testing.assert_allclose(plant.act(FRAMES), (scaled + 1) / 2 * (high - low) + low)
    np.testing.assert_array_equal(replace(policy, log=None).act(FRAMES), scaled)


def test_candidates_are_drawn_from_a_stream_of_the_policy_or_a_given_one() -> None:
    generator = torch.Generator().manual_seed(0)
    base = made("bear", kind="gaussian_candidates", candidates=5, noise=3)
    actor = [(torch.randn(2, 24, 6, generator=generator), torch.zeros(2, 1, 6))]
    critic = [(torch.randn(2, 27, 1, generator=generator), torch.zeros(2, 1, 1))]
    stack = StoredPolicy.of_networks(
        base.stack.card, {"actor": actor, "critic": critic}, base.stack.frames
    )
    one, other = replace(base, stack=stack), replace(base, stack=stack)
    first = one.act(FRAMES)
    np.testing.assert_array_equal(first, other.act(FRAMES))
    assert not np.array_equal(first, one.act(FRAMES))
    drawn = [one.act(FRAMES, noise=np.random.default_rng(2)) for _ in range(2)]
    np.testing.assert_array_equal(*drawn)


HOLE = FRAMES.copy()
HOLE[3, 4] = np.nan


@pytest.mark.parametrize(
    ("algorithm", "history", "proximity", "reason"),
    [
        ("lion", FRAMES, None, "A policy of lion needs proximity; give a number from 0"),
        ("bc", FRAMES, 0.3, "A policy of bc takes no proximity; leave it out."),
        ("lion", FRAMES, 1.1, r"proximity=1.1 must lie in \[0, 1\]"),
        ("lion", FRAMES, np.nan, r"proximity=nan must lie in \[0, 1\]"),
        ("lion", FRAMES, [0.1, 0.2], "is neither a number nor one for each of 1 histories"),
        ("lion", FRAMES, "much", "proximity='much' is neither a number"),
        ("bc", FRAMES[:, :4], None, "The history has 4 values a frame; give the 6 values setpoint"),
        ("bc", FRAMES[0], None, r"The history has the shape \(6,\); give \[T, F\] frames"),
        ("bc", FRAMES[:0], None, r"The history has the shape \(0, 6\)"),
        ("bc", [["a"] * 6], None, "The history holds no plain numbers"),
        ("bc", HOLE, None, "The history holds nan for 'fatigue' in frame 3; the policy needs"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    algorithm: str, history: Any, proximity: Any, reason: str
) -> None:
    with pytest.raises(ValueError, match=reason) as error:
        made(algorithm).act(history, proximity)
    assert "\n" not in str(error.value)


def test_rows_of_a_table_are_called_by_their_labels_and_one_may_be_given_alone() -> None:
    table = pd.DataFrame(FRAMES, columns=list(FEATURES), index=range(40, 49))
    table.insert(0, "time", pd.Timestamp("2026-03-01"))  # no feature, and no number
    policy = made("bc")
    np.testing.assert_array_equal(policy.act(table.iloc[-1]), policy.act(FRAMES[-1:]))
    table.loc[43, "fatigue"] = np.nan
    with pytest.raises(ValueError, match="holds nan for 'fatigue' in row 43"):
        policy.act(table)


@pytest.mark.parametrize("shape", ["one", "several"])
def test_values_in_another_unit_or_order_are_warned_of(shape: str) -> None:
    policy, strange = made("bc"), FRAMES.copy()
    strange[5, 4] = 1e4
    with pytest.warns(FarFromLogWarning, match=r"fatigue is 10000, \d+ standard deviations from"):
        policy.act(strange if shape == "one" else np.stack([FRAMES, strange]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy.act(FRAMES)
        policy.act(FRAMES + 5 * LOG.frames.std(axis=0))  # far, as a fault of the plant may be


def test_what_is_no_folder_of_a_policy_says_what_is_meant(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="There is no folder"):
        pb.load(tmp_path / "nothing")
    (tmp_path / "policy.onnx").write_bytes(b"")
    with pytest.raises(ValueError, match="an exported policy runs in onnxruntime"):
        pb.load(tmp_path / "policy.onnx")


def test_snapshots_are_known_by_their_updates() -> None:
    assert made().at(5).steps == (5,)
    with pytest.raises(ValueError, match=r"There is no snapshot of update 6; there are 5, 10\."):
        made().at(6)


def test_saved_and_loaded_it_is_the_same(tmp_path: Path) -> None:
    policy = replace(
        made(), log=replace(LOG.card, action_bounds=BOUNDS), behaviour=made("bc").stack
    )
    policy.save(tmp_path / "new" / "furnace")
    loaded = pb.load(tmp_path / "new" / "furnace")
    np.testing.assert_array_equal(loaded.act(FRAMES, 0.4), policy.act(FRAMES, 0.4))
    assert (loaded.seed, loaded.log, loaded.steps) == (7, policy.log, (5, 10))
    assert loaded.behaviour is not None
    assert loaded.behaviour.card == made("bc").stack.card
    assert StoredPolicy.load(tmp_path / "new" / "furnace").card == policy.stack.card
    assert repr(loaded) == "Policy(lion on toy, seed 7, update 10)"
    with pytest.raises(ValueError, match=r"furnace is not empty; remove it or save the policy"):
        policy.save(tmp_path / "new" / "furnace")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["furnace"]


def test_a_policy_without_a_log_is_saved_and_loaded_too(tmp_path: Path) -> None:
    replace(made(), log=None).save(tmp_path / "p")
    assert pb.load(tmp_path / "p").log is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda origin: origin.pop("seed"), "cannot be used ('seed'"),
        (lambda origin: origin.update(format="other"), "its format is 'other'"),
        (lambda origin: origin["log"].pop("discount"), "missing or unknown fields (discount)"),
        (lambda origin: origin["log"].update(history=9), "and the card of another log"),
    ],
)
def test_a_damaged_origin_is_refused(tmp_path: Path, change: Any, reason: str) -> None:
    made().save(tmp_path / "p")
    path = tmp_path / "p" / "origin.json"
    origin = json.loads(path.read_text(encoding="utf-8"))
    change(origin)
    path.write_text(json.dumps(origin), encoding="utf-8")
    with pytest.raises(DamagedFileError) as error:
        pb.load(tmp_path / "p")
    assert reason in str(error.value)


def test_a_missing_policy_is_a_value_error_and_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="There is no policy in") as error:
        pb.load(tmp_path)
    assert isinstance(error.value, ValueError)


def test_only_registered_systems_can_evaluate() -> None:
    with pytest.raises(ValueError, match="toy names no registered system, so its policies cannot"):
        made().evaluate()


@pytest.mark.parametrize("given", [None, LOG])
def test_exported_it_acts_the_same_in_the_units_of_the_log(given: Any, tmp_path: Path) -> None:
    policy = replace(made(), log=replace(LOG.card, action_bounds=BOUNDS))
    path = tmp_path / "policy.pt2"
    checked = policy.export(path, given)
    assert checked.states == (1000 if given is None else LOG.transitions)
    inputs = {"history": FRAMES[-4:][::-1][None].copy(), "proximity": np.float32([0.3])}
    # float32 against the library's double precision
    np.testing.assert_allclose(
        FORMATS[".pt2"].read(path)(inputs)[0], policy.act(FRAMES, 0.3), rtol=1e-5, atol=1e-5
    )
    extra = {"card.json": ""}
    torch.export.load(path, extra_files=extra)
    card = json.loads(extra["card.json"])
    assert (card["seed"], card["updates"]) == (7, 10)
    said = "drawn from the moments of" if given is None else "recorded, evenly over toy"
    assert card["check"]["source"].startswith(said)
    with pytest.raises(ValueError, match=r"policy\.pt2 exists; name another file, or overwrite it"):
        policy.export(path)
    policy.export(path, overwrite=True)


def test_an_export_of_a_policy_without_a_log_numbers_its_actions(tmp_path: Path) -> None:
    extra = {"card.json": ""}
    replace(made("bc"), log=None).export(tmp_path / "policy.pt2")
    torch.export.load(tmp_path / "policy.pt2", extra_files=extra)
    output = json.loads(extra["card.json"])["output"]
    assert output["actions"] == ["action 0", "action 1", "action 2"]
    assert output["units"] == "scaled to [-1, 1]"
    with pytest.raises(ValueError, match=r"^The log robot has other features; the policy sees set"):
        made("bc").export(tmp_path / "other.pt2", ROBOT)
