"""A session that the console has recorded is a log: the door of foreign logs takes it as it is."""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from components.data.dataset import OfflineDataset
from components.operating.operable import SHIPPED, Operable
from components.operating.recording import Recording
from components.operating.session import Session, Step
from flows import import_log as door
from flows.command_line import run_door
from flows.configuration import files

UNTOUCHED = {("turbine", 0)}
"""The setpoint, which is a column of its table and never changes."""


@pytest.mark.parametrize("of", ["world", "turbine"])
def test_a_recorded_session_is_imported(
    of: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    operable = Operable.load(SHIPPED / of)
    session, recording = Session(operable, seed=3), Recording(operable, of, 3)
    steps: list[Step] = []
    for number in range(60):
        if session.takes_proximity:
            session.proximity = (number % 11) / 10
        session.driver = "behaviour" if number % 7 == 3 else "operator"
        if number in (21, 22):  # the second time after a single step: no whole one
            session.restart()
        steps.append(session.step())
        recording.add(steps[-1])
    recording.save(tmp_path / "saved")

    (tmp_path / "conf" / "dataset").mkdir(parents=True)
    monkeypatch.setattr(files, "CONF", tmp_path / "conf")
    monkeypatch.setattr(door, "report_figure", lambda dataset: Figure((1, 1)))  # drawing is slow
    words = ["session.csv", "name=session", "schema=session.yaml", "short=drop"]
    monkeypatch.chdir(tmp_path / "saved")
    monkeypatch.setattr(sys, "argv", ["import_log", *words])
    with pytest.raises(SystemExit) as ended:
        run_door("import_log", door.HELP, door.load_import_settings, door.import_log)
    assert not ended.value.code, capsys.readouterr().err

    log = OfflineDataset.open(tmp_path / "logs" / "session")
    card = operable.card
    moved = [name for n, name in enumerate(card.frame_features) if (of, n) not in UNTOUCHED]
    assert len(log.card.frame_features) == len(moved)
    assert (log.card.history, log.card.discount) == (card.history, card.discount)
    kept = [
        step
        for step, following in pairwise(steps)
        if following.episode == step.episode  # the outcome of the last one is not recorded
    ]
    assert log.transitions == len(kept)
    # Single precision, of values up to 100.
    np.testing.assert_allclose(log.rewards, [s.rewards[0] for s in kept], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(log.actions, [s.actions[0] for s in kept], atol=1e-5)
    starts = log.episode_starts[:-1] + np.arange(log.episodes)
    begun = np.array([s.frames[0] for s in kept if s.step == 0])[:, -len(moved) :]
    np.testing.assert_allclose(log.frames[starts], begun, rtol=1e-6, atol=1e-6)
