"""Searches of a toy model: what a study holds afterwards, interrupted or not."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from optuna.trial import TrialState

from flows.pipeline.errors import PipelineError
from flows.pipeline.locks import locked
from flows.pipeline.outcome import STOPPED
from flows.pipeline.plan import digest
from flows.pipeline.store import ArtifactStore
from flows.tuning import space as spaces
from flows.tuning.journal import open_journal
from flows.tuning.study import _COMPARED_FROM, _PATIENCE, ended_trials, has_ended
from tests.flows.pipeline.toys import counted
from tests.flows.tuning.toys import SPACE, STEPS, ToyConfig, run, specification, study


@pytest.fixture
def log(tmp_path: Path) -> Path:
    folder = tmp_path / "log"
    folder.mkdir()
    return folder


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "mlruns"


def test_the_start_is_the_first_trial_and_the_best_is_never_worse(home: Path, log: Path) -> None:
    notes: list[str] = []
    outcome = run(home, log, 12, notes=notes)
    assert (outcome.status, outcome.exit_code) == ("FINISHED", 0)
    made = study(home, log)
    first, *others = made.trials()
    assert made.config(first) == ToyConfig(log=str(log))
    assert made.start_trial().number == 0
    assert first.value == pytest.approx(0.36)  # (0.9 - 0.3) squared
    assert len(others) == 11
    assert made.best().value == min(t.value for t in made.trials() if t.value is not None)
    assert made.best().value < first.value
    assert len({t.params["x"] for t in made.trials()}) == 12
    assert "trial 0 (1 of 12): 0.36; best 0.36 of trial 0" in notes[0]
    store = ArtifactStore(home)
    assert list(store.work.iterdir()) == []
    assert list((home / "progress").iterdir()) == []
    assert list(store.locks.iterdir()) == []


def test_more_trials_extend_a_study_and_nothing_is_drawn_twice(home: Path, log: Path) -> None:
    for trials in (5, 5, 10, 15):
        assert run(home, log, trials).exit_code == 0
        assert study(home, log).ended == trials
    trials = study(home, log).trials()
    assert [t.number for t in trials] == list(range(15))
    assert len({t.params["x"] for t in trials}) == 15
    assert ended_trials(home / "optuna" / "journal.log", [specification(log)]) == {
        specification(log).name: 15
    }


def test_pruned_trials_end_early_and_are_not_failures(home: Path, log: Path) -> None:
    made = study(home, log)
    made.recover()
    for k in range(_COMPARED_FROM - 1):  # beside the start
        drawn = {"x": 0.3 + 0.01 * k, "mood": "good"}
        made._study.enqueue_trial(drawn)
    made._study.enqueue_trial({"x": 0.4, "mood": "bad"})
    assert run(home, log, _COMPARED_FROM + 1).exit_code == 0
    *others, last = study(home, log).trials()
    assert {t.state for t in others} == {TrialState.COMPLETE}
    assert last.state is TrialState.PRUNED
    node = specification(log).node_of(last.params, last.number)
    done = counted(log, f"step-{node.key}")
    assert done == round(_PATIENCE / 100 * STEPS)  # as soon as its patience ends
    assert counted(log, f"finished-{node.key}") == 0
    assert has_ended(last)
    assert not ArtifactStore(home).complete(node.key)
    assert list(ArtifactStore(home).work.iterdir()) == []
    # and is not tried again
    assert run(home, log, _COMPARED_FROM + 1).exit_code == 0
    assert counted(log, f"step-{node.key}") == done


def test_pruning_is_decided_again_whenever_another_trial_ends(home: Path, log: Path) -> None:
    made = study(home, log)
    made.recover()
    others = [made.ask() for _ in range(_COMPARED_FROM)]
    bad = made.ask()
    for trial in [*others, bad]:
        made.report(trial, 0.65, 9.0 if trial is bad else 1.0)
    for trial in others:
        assert not made.should_prune(bad)  # too few to compare with
        made.complete(trial, 1.0)
    assert made.should_prune(bad)  # without a new loss of its own


def test_a_trial_marked_for_pruning_is_pruned_after_a_kill(home: Path, log: Path) -> None:
    made = study(home, log)
    made.recover()
    trial = made.ask()
    node = specification(log).node_of(trial.params, 0)
    trial.set_user_attr("key", node.key)
    made.report(trial, 0.3, 5.0)
    made.mark_for_pruning(trial)
    work = ArtifactStore(home).open_work([node.key])
    (work.path / "checkpoint").touch()
    # ... and here the driver was killed
    assert run(home, log, 2).exit_code == 0
    first, second = study(home, log).trials()
    assert (first.state, first.value) == (TrialState.PRUNED, 5.0)
    assert second.state is TrialState.COMPLETE
    assert not work.path.exists()


def test_failing_trials_say_why_and_the_search_goes_on(home: Path, log: Path) -> None:
    (log / "fail-bad").touch()
    made = study(home, log)
    made.recover()
    made._study.enqueue_trial({"x": 0.0, "mood": "good"})
    made._study.enqueue_trial({"x": 0.5, "mood": "bad"})
    notes: list[str] = []
    assert run(home, log, 4, notes=notes).exit_code == 0
    trials = study(home, log).trials()
    assert [t.state.name for t in trials[:3]] == ["COMPLETE", "FAIL", "FAIL"]
    assert trials[1].user_attrs["error"] == "x must not be 0."
    said = trials[2].user_attrs["error"]
    assert said.startswith("ValueError: this toy is in a bad mood (")
    assert said.endswith(", in fit)")
    assert study(home, log).ended == len(trials) == 4
    assert any("failed: ValueError: this toy is in a bad mood" in note for note in notes)


def test_a_search_of_failures_only_fails(home: Path, log: Path) -> None:
    (log / "fail-bad").touch()
    made = study(home, log, mood="bad")
    outcome = run(home, log, 1, mood="bad")
    assert (outcome.exit_code, outcome.failed) == (1, [made.name])


def test_infinite_losses_are_failures(
    home: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.flows.tuning.toys.loss", lambda settings: float("nan"))
    assert run(home, log, 2).exit_code == 1
    assert {t.user_attrs["error"] for t in study(home, log).trials()} == {
        "The held-out loss is missing or not finite."
    }


def test_ctrl_c_ends_the_search_and_the_next_one_continues_it(home: Path, log: Path) -> None:
    (log / "interrupt").touch()
    outcome = run(home, log, 3)
    assert (outcome.status, outcome.exit_code, outcome.failed) == ("KILLED", 130, [])
    assert [t.state.name for t in study(home, log).trials()] == ["RUNNING"]
    assert run(home, log, 3).exit_code == 0
    made = study(home, log)
    assert [t.state.name for t in made.trials()] == ["FAIL", *["COMPLETE"] * 3]
    assert made.start_trial().number == 1
    assert made.ended == 3
    key = specification(log).node_of(made.trials()[1].params, 1).key
    assert counted(log, f"step-{key}") == STEPS + 1  # step 5 was begun twice


def test_a_search_stops_at_its_limit_and_the_next_one_continues_it(home: Path, log: Path) -> None:
    key = specification(log).node(ToyConfig(log=str(log))).key  # of the start, the first trial
    notes: list[str] = []
    late = "max_hours=8 are over"
    outcome = run(
        home, log, 3, notes=notes, limit=lambda: late if counted(log, f"step-{key}") >= 5 else ""
    )
    assert (outcome.status, outcome.exit_code) == ("KILLED", STOPPED)
    assert "Stopping, since max_hours=8 are over." in notes
    assert run(home, log, 3).exit_code == 0
    assert study(home, log).ended == 3
    assert counted(log, f"step-{key}") == STEPS, "the checkpoint was used"


def test_what_is_finished_elsewhere_is_not_fitted_again(home: Path, log: Path) -> None:
    run(home, log, 4)
    (home / "optuna" / "journal.log").unlink()
    run(home, log, 1)
    made = study(home, log)
    key = made.trials()[0].user_attrs["key"]
    assert counted(log, f"finished-{key}") == 1
    assert made.best().value == pytest.approx(0.36)


def test_a_new_start_is_tried_in_a_study_that_has_all_its_trials(home: Path, log: Path) -> None:
    run(home, log, 2)
    other = study(home, log, x=0.5)
    assert other.name == study(home, log).name
    assert other.start_trial() is None
    run(home, log, 2, x=0.5)
    assert study(home, log, x=0.5).start_trial().value == pytest.approx(0.04)
    # what is not searched and changes the loss makes another study
    assert study(home, log, steps=3).name != other.name


def test_losses_on_other_data_or_of_newer_code_belong_to_another_study(log: Path) -> None:
    one = specification(log)
    other_data = replace(one, data=replace(one.data, version=2))
    newer_code = replace(one, node=lambda config: replace(one.node(config), version=2))
    assert len({one.name, other_data.name, newer_code.name}) == 3


def test_two_drivers_never_search_one_study(home: Path, log: Path) -> None:
    store = ArtifactStore(home)
    name = study(home, log).name
    with (
        locked(store.locks / f"study-{digest(name, 8)}.lock"),
        pytest.raises(PipelineError, match=f"Another process searches {name}: wait for it"),
    ):
        run(home, log, 1)


def test_a_half_written_line_of_the_journal_is_cut(home: Path, log: Path) -> None:
    run(home, log, 2)
    path = home / "optuna" / "journal.log"
    with path.open("a") as file:
        file.write('{"op_code": 4, "wor')
    assert run(home, log, 3).exit_code == 0
    assert study(home, log).ended == 3
    open_journal(path)
    assert path.read_bytes().endswith(b"\n")


def test_drawing_the_same_twice_costs_one_fit(home: Path, log: Path) -> None:
    made = study(home, log)
    made.recover()
    for _ in range(2):
        made._study.enqueue_trial({"x": 0.5, "mood": "good"})
    run(home, log, 3)
    one, two = study(home, log).trials()[1:]
    assert one.value == two.value
    node = specification(log).node(spaces.settings(SPACE, specification(log).start, one.params))
    assert counted(log, f"finished-{node.key}") == 1


def points(what: str, folder: Path) -> list[str]:
    command = [sys.executable, "-m", "tests.flows.tuning.crash_points", what, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow(4)
def test_driver_killed_after_ask_in_a_fit_and_before_tell(tmp_path: Path) -> None:
    *problems, last = points("calls", tmp_path)
    assert problems == []
    assert last == "points: 7"


@pytest.mark.slow(27)
def test_driver_killed_at_every_change_of_the_disk(tmp_path: Path) -> None:
    *problems, last = points("disk", tmp_path)
    assert problems == []
    assert int(last.removeprefix("points: ")) > 60  # fewer would mean the hook sees nothing
