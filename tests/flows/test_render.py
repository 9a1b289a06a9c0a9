"""The door that films stored policies: how it finds them, what it refuses, a real film."""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest

from components.core.files import write_json
from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.environments.mujoco.specifications import HOPPER
from components.environments.rendering import Take, drawing_library
from components.policies.policy import Policy
from flows import render
from flows.command_line import run_door
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_setup import import_mlflow
from flows.stored_policy import find_policy
from tests.components.synthetic import constant_policy, make_log
from tests.flows.pipeline.toys import record_of

DATA, HOPPING, TWIN, ADAPTIVE, INDUSTRIAL = (letter * 32 for letter in "abcde")
MACHINE_DATA = "f" * 32


def finish(store: ArtifactStore, key: str, name: str, component: str, **inputs: str) -> Path:
    record = record_of(key, name=name, component=component, inputs=inputs)
    write_json(store.path(key) / "node.json", record)
    return store.path(key)


def add_dataset(store: ArtifactStore, key: str, environment: str, parameters: Any) -> None:
    folder = finish(store, key, f"data/{key[0]}", "data_generation") / "dataset"
    folder.mkdir()
    card = dataclasses.replace(
        make_log().card, environment=environment, environment_parameters=parameters
    )
    (folder / "card.json").write_text(card.to_json(), encoding="utf-8")


def add_policy(store: ArtifactStore, key: str, name: str, dataset: str, **card: Any) -> None:
    """Two snapshots: the first does nothing, the last one acts."""
    snapshots = [
        constant_policy(actions, HOPPER.frame_features, history=1)
        for actions in ([0.0, 0.0, 0.0], [0.5, -0.5, 0.25])
    ]
    told = {"features": HOPPER.frame_features, "steps": (1, 2), **card}
    policy = Policy.concatenate(dataclasses.replace(snapshots[0].card, **told), snapshots)
    folder = finish(store, key, name, "policy_training", dataset=dataset) / "policy"
    folder.mkdir()
    policy.save(folder)


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    store = ArtifactStore(tmp_path / "runs")
    for key in (DATA, HOPPING, TWIN, ADAPTIVE, INDUSTRIAL, MACHINE_DATA):
        store.path(key).mkdir()
    add_dataset(store, DATA, HOPPER.id, {"physics": "v3"})
    add_dataset(store, MACHINE_DATA, INDUSTRIAL_BENCHMARK_ID, {"setpoint": 70.0})
    add_policy(store, HOPPING, "bc/hopper/seed0", DATA)
    add_policy(store, TWIN, "bc/hopper/seed1", DATA)
    add_policy(store, ADAPTIVE, "lion/hopper/seed0", DATA, takes_proximity=True)
    add_policy(store, INDUSTRIAL, "bc/bad-0.4/seed0", MACHINE_DATA)
    return store


def door(store: ArtifactStore, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["render", f"store={store.root}", *words])
    with pytest.raises(SystemExit) as ended:
        run_door("render", render.HELP, render.load_render_settings, render._run)
    return int(ended.value.code or 0)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
@pytest.mark.slow(2)
def test_a_stored_policy_is_filmed(
    suffix: str,
    store: ArtifactStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    try:
        monkeypatch.setenv("MUJOCO_GL", drawing_library())
    except OSError as error:
        pytest.skip(str(error))
    out = tmp_path / "films" / f"hopper{suffix}"
    words = ["run=bc/hopper/seed0", f"out={out}", "steps=10", "size=64"]
    assert door(store, monkeypatch, *words) == 0
    assert "bc/hopper/seed0 for 10 steps (0.1 s) without a fall" in capsys.readouterr().out
    with imageio.get_reader(out) as reader:
        pictures = list(reader.iter_data())
        told = reader.get_meta_data()
    assert len(pictures) == 3  # steps 0, 5 and 10
    assert pictures[0].shape[:2] == (64, 64)
    assert told["duration"] == (40 if suffix == ".gif" else pytest.approx(3 / 25, abs=0.01))
    assert [file.name for file in out.parent.iterdir()] == [out.name]


def test_the_last_snapshot_acts_in_the_dataset_s_environment(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: dict[str, Any] = {}

    def film(environment: str, parameters: Any, act: Any, draw: Any, **options: Any) -> Take:
        asked.update(environment=environment, parameters=parameters, options=options)
        asked["action"] = act(np.zeros((1, 1, 11)))
        draw(np.zeros((16, 16, 3), dtype=np.uint8))
        return Take(1, 0.1, True, 0.0)

    monkeypatch.setattr(render, "film", film)
    out = f"out={tmp_path / 'a.gif'}"
    assert door(store, monkeypatch, f"run={TWIN}", out, "seed=4", "steps=7", "size=32") == 0
    assert (asked["environment"], asked["parameters"]) == (HOPPER.id, {"physics": "v3"})
    assert asked["options"] == {"history": 1, "steps": 7, "seed": 4, "size": 32}
    assert asked["action"] == pytest.approx([0.5, -0.5, 0.25])


def test_the_proximity_is_turned_during_a_film_and_held_at_its_ends() -> None:
    settings = render.load_render_settings(["run=a", "out=a.gif", "lambda=0.2..0.8"])
    turned = [settings.proximity_at(step, 101) for step in range(101)]
    assert turned[0] == turned[15] == 0.2
    assert turned[50] == pytest.approx(0.5)
    assert turned[85] == turned[100] == pytest.approx(0.8)
    assert turned == sorted(turned)
    still = render.load_render_settings(["run=a", "out=a.gif", "lambda=0.2"])
    assert {still.proximity_at(step, 5) for step in range(5)} == {0.2}


@pytest.mark.slow(3)
def test_a_system_without_a_camera_is_filmed_as_the_console_shows_it(
    store: ArtifactStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "world.gif"
    assert door(store, monkeypatch, "run=world", f"out={out}", "lambda=0..1", "steps=6") == 0
    said = capsys.readouterr().out
    assert "world for 6 steps; sum of rewards" in said
    assert "of the behaviour beside it" in said
    with imageio.get_reader(out) as reader:
        pictures = list(reader.iter_data())
    assert len(pictures) == 6
    assert pictures[0].shape[:2] == (448, 720)
    assert (pictures[0] != pictures[-1]).any()


def test_a_film_that_fails_leaves_no_file(
    store: ArtifactStore,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*arguments: Any, **options: Any) -> Take:
        arguments[3](np.zeros((16, 16, 3), dtype=np.uint8))
        raise OSError("Nothing here can draw without a screen.")

    monkeypatch.setattr(render, "film", fail)
    out = tmp_path / "films" / "a.gif"
    assert door(store, monkeypatch, f"run={HOPPING}", f"out={out}") == 1
    assert capsys.readouterr().err == "render: Nothing here can draw without a screen.\n"
    assert not list(out.parent.iterdir())


@pytest.mark.slow(3)
def test_a_policy_is_found_by_its_run_in_mlflow(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = f"sqlite:///{store.root / 'elsewhere.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
    client = import_mlflow().MlflowClient(tracking_uri=address)
    experiment = client.create_experiment("any", artifact_location=str(store.root))
    run = client.create_run(experiment, tags={"key": TWIN}).info.run_id
    assert find_policy(store, run)["name"] == "bc/hopper/seed1"
    with pytest.raises(render.SettingsError, match="holds no such finished run"):
        find_policy(store, "0" * 32)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["out=a.gif"], "run= is missing; write run=ID out=FILE"),
        (["run=x"], "out= is missing; write run=ID out=FILE"),
        (["run=x", "out=a.avi"], "out=a.avi must end in .mp4 or .gif."),
        (
            ["run=x", "out=a.gif", "sise=3"],
            "Unknown key 'sise'; valid keys there: run, out, proximity, steps",
        ),
        (["run=x", "out=a.gif", "size=40"], "size='40': Input should be a multiple of 16."),
        (
            ["run=x", "out=a.gif", "proximity=2"],
            "proximity='2': Input should be less than",
        ),
        (["run=x", "out=a.gif", "steps"], "'steps' is not an override; write key=value"),
        (["run=x", "out=a.gif", "out=b.gif"], "out is given twice; give it once."),
        (["run=x", "out=a.gif", "lambda=0..1", "lambda=0"], "lambda is given twice; give it once."),
        (["run=x", "out=a.gif", "lambda=0..1", "lambda=0..0.5"], "lambda is given twice; give it"),
        (["run=x", "out=a.gif", "lambda=0", "proximity=0..1"], "lambda is given twice; give it"),
        (["run=x", "out=a.gif", "last_proximity=1"], "last_proximity is written lambda=0..1."),
        (["run=bc/hopper/seed9", "out=a.gif"], "holds no such finished run; give the id of a run"),
        (
            [f"run={DATA}", "out=a.gif"],
            "is not a policy but a run of data_generation; give",
        ),
        (["run=bc/hopper/seed0", "out=a.gif", "proximity=1"], "takes no proximity."),
        (
            ["run=lion/hopper/seed0", "out=a.gif"],
            "needs proximity; add e.g. proximity=0.5, or lambda=0..1.",
        ),
        (["run=lion/hopper/seed0", "out=a.gif", "lambda=0..2"], "last_proximity='2': Input should"),
        (["run=world", "out=a.gif"], "needs proximity; add e.g. proximity=0.5, or lambda=0..1."),
    ],
)
def test_refusals(
    words: list[str],
    message: str,
    store: ArtifactStore,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert door(store, monkeypatch, *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_name_of_several_runs_needs_a_key(store: ArtifactStore) -> None:
    again = "9" * 32
    store.path(again).mkdir()
    finish(store, again, "bc/hopper/seed0", "policy_training", dataset=DATA)
    with pytest.raises(render.SettingsError, match=f"give one of the keys {again}, {HOPPING}"):
        find_policy(store, "bc/hopper/seed0")
    assert find_policy(store, HOPPING)["key"] == HOPPING


@pytest.mark.parametrize("word", ["proximity", "lambda"])
def test_lambda_is_accepted_as_the_old_name_of_proximity(word: str) -> None:
    settings = render.load_render_settings(["run=x", "out=a.gif", f"{word}=0.25"])
    assert settings.proximity == 0.25
