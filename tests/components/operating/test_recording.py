"""Recordings: what is in them, that they are logs, and that they replay to the byte."""

import csv
import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest

from components.core.integrity import DamagedFileError
from components.operating.operable import Operable
from components.operating.recording import Recording, card_of, replay
from components.operating.session import Session
from tests.components.operating.machines import recorded, turbine
from tests.components.synthetic import constant_policy


def record(operable: Operable, seed: int = 7) -> tuple[Recording, list]:
    """A session in which everything is turned that can be."""
    session, recording = Session(operable, seed), Recording(operable, "some/policy", seed)
    steps = []
    for number in range(40):
        if operable.policy.card.takes_proximity:
            session.proximity = (number % 11) / 10
        session.driver = "behaviour" if number % 7 == 3 else "operator"
        if number == 5 and session.plant.setpoint is not None:
            session.plant.demand(55.0)
        if number == 17:
            session.restart()
        steps.append(session.step())
        recording.add(steps[-1])
    return recording, steps


@pytest.mark.parametrize("make", [turbine, recorded])
def test_a_recording_replays_to_the_byte(make, tmp_path: Path) -> None:
    recording, _ = record(make())
    recording.save(tmp_path / "saved")
    assert replay(tmp_path / "saved", make()) == 40
    assert card_of(tmp_path / "saved").policy == "some/policy"


def test_a_recording_holds_what_happened() -> None:
    recording, steps = record(turbine())
    rows = list(csv.DictReader(io.StringIO(recording.table)))
    assert recording.steps == len(rows) == 40
    for row, step in zip(rows, steps, strict=True):
        assert float(row["lambda"]) == step.proximity
        assert row["driver"] == step.driver
        assert float(row["reward"]) == step.rewards[0]
        assert float(row["behaviour reward"]) == step.rewards[1]
        assert float(row["fatigue"]) == step.frames[0, 4]
        assert float(row["action gain"]) == pytest.approx(step.actions[0, 1], abs=1e-15)
    schema = json.loads(recording.schema)
    assert schema["actions"]["action gain"] == [-1.0, 1.0]
    assert schema["outcome_row"] == "same"


def test_what_was_proposed_on_recorded_states_is_no_log_to_learn_from(tmp_path: Path) -> None:
    """Its states and rewards are those of other actions."""
    recording, _ = record(recorded())
    recording.save(tmp_path / "saved")
    assert sorted(p.name for p in (tmp_path / "saved").iterdir()) == ["session.csv", "session.json"]
    assert not recording.is_log
    head = recording.table.splitlines()[0].split(",")
    assert not any(name.startswith("action ") for name in head)
    assert any(name.startswith("proposed ") for name in head)
    real, _ = record(turbine())
    real.save(tmp_path / "real")
    assert real.is_log
    assert (tmp_path / "real" / "session.yaml").exists()


def test_names_of_an_own_log_may_be_those_of_the_tables_columns(tmp_path: Path) -> None:
    """Two columns of one name could be neither replayed nor imported."""
    operable = recorded()
    names = ("step", "driver", "lambda", "log step", "proposed pump", "strangeness")
    policy = constant_policy([0.1, 0.0, 0.0], names, history=1)
    actions = ("pump", "episode", "reward")
    card = dataclasses.replace(operable.card, frame_features=names, action_features=actions)
    own = dataclasses.replace(operable, policy=policy, card=card, familiar=None)
    recording, steps = record(own)
    head, first = (recording.table.splitlines()[n].split(",") for n in (0, 1))
    assert len(set(head)) == len(head)
    schema = json.loads(recording.schema)
    assert schema["features"][0] == "log driver"  # nothing changed the setpoint, here "step"
    assert list(schema["actions"]) == ["log proposed pump", "proposed episode", "proposed reward"]
    row = dict(zip(head, first, strict=True))
    seen = [float(row[name]) for name in schema["features"]]
    assert seen == steps[0].frames[0, 1:].tolist()
    recording.save(tmp_path / "saved")
    assert replay(tmp_path / "saved", own) == 40


@pytest.mark.parametrize(("old", "new"), [("0.4", "0.5"), ("operator", "behaviour")])
def test_a_changed_recording_is_noticed(old: str, new: str, tmp_path: Path) -> None:
    recording, _ = record(turbine())
    recording.save(tmp_path / "saved")
    path = tmp_path / "saved" / "session.csv"
    lines = path.read_text().splitlines()
    number = next(n for n, line in enumerate(lines) if f",{old}," in line)
    lines[number] = lines[number].replace(f",{old},", f",{new},", 1)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="does not replay: line"):
        replay(tmp_path / "saved", turbine())


@pytest.mark.parametrize(
    "row", ["0,0,operator,2.0,70.0", "0,0,nobody,0.1,70.0", "x,0,operator,0.1,70.0", "0,0"]
)
def test_a_damaged_recording_is_refused(row: str, tmp_path: Path) -> None:
    recording, _ = record(turbine())
    recording.save(tmp_path / "saved")
    path = tmp_path / "saved" / "session.csv"
    head = path.read_text().splitlines()[0]
    path.write_text(f"{head}\n{row}\n")
    with pytest.raises(DamagedFileError, match="damaged in line 2"):
        replay(tmp_path / "saved", turbine())


def test_a_recording_of_other_weights_is_refused(tmp_path: Path) -> None:
    recording, _ = record(turbine())
    recording.save(tmp_path / "saved")
    with pytest.raises(DamagedFileError, match="other weights"):
        replay(tmp_path / "saved", turbine(constant_policy([0.1, 0.0, 0.0])))


def test_what_is_operated_survives_the_disk(tmp_path: Path) -> None:
    before = turbine()
    before.save(tmp_path / "packed")
    after = Operable.load(tmp_path / "packed")
    assert after.digest == before.digest
    assert after.card == before.card
    assert after.familiar is not None
    assert before.familiar is not None
    assert after.familiar.limit == before.familiar.limit
    left, right = Session(before), Session(after)
    for _ in range(3):
        a, b = left.step(), right.step()
        np.testing.assert_array_equal(a.rewards, b.rewards)
        assert a.strangeness == pytest.approx(b.strangeness)
    (tmp_path / "packed" / "familiar.safetensors").write_bytes(b"no tensors")
    with pytest.raises(DamagedFileError):
        Operable.load(tmp_path / "packed")
