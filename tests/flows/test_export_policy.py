"""The door that takes policies away: how it finds them, what it refuses, models of MLflow."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from components.core.files import write_json
from components.policies.policy import Policy
from components.policies.portable_files import FORMATS
from flows import export_policy as door_module
from flows.command_line import run_door
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_setup import import_mlflow
from tests.components.synthetic import constant_policy, make_log, policy_card, random_policy
from tests.flows.pipeline.toys import record_of, wait_for
from tests.walled import run_walled

DATA, PLAIN, STEERED = (letter * 32 for letter in "abc")
BOUNDS = ((0.0, 100.0), (-5.0, 5.0), (10.0, 20.0))


def plant_log():
    log = make_log()
    return replace(log, card=replace(log.card, action_bounds=BOUNDS))


LOG = plant_log()


def steered() -> Policy:
    """A policy whose first action follows the proximity."""
    weight = torch.zeros(1, 19, 3)
    weight[0, 18, 0] = 1.0
    card = policy_card(LOG, algorithm="lion", takes_proximity=True)
    like = random_policy(LOG, ("a",))
    return Policy.of_networks(card, {"actor": [(weight, torch.zeros(1, 1, 3))]}, like.frames)


def finish(store: ArtifactStore, key: str, name: str, component: str, **inputs: str) -> Path:
    store.path(key).mkdir()
    record = record_of(key, name=name, component=component, inputs=inputs)
    write_json(store.path(key) / "node.json", record)
    return store.path(key)


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ArtifactStore:
    """A log of a plant, a policy with two snapshots, the last of which is constant, and a LION."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    store = ArtifactStore(tmp_path / "runs")
    LOG.write(finish(store, DATA, "data/toy", "data_generation") / "dataset")
    snapshots = [constant_policy([0.0, 0.0, 0.0]), constant_policy([0.5, -0.5, 0.25])]
    card = replace(snapshots[0].card, steps=(10, 20))
    for key, name, policy in (
        (PLAIN, "bc/toy/seed0", Policy.concatenate(card, snapshots)),
        (STEERED, "lion/toy/seed0", steered()),
    ):
        folder = finish(store, key, name, "policy_training", dataset=DATA) / "policy"
        folder.mkdir()
        policy.save(folder)
    return store


def door(store: ArtifactStore, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["export_policy", f"store={store.root}", *words])
    with pytest.raises(SystemExit) as ended:
        run_door(
            "export_policy", door_module.HELP, door_module.load_export_settings, door_module._run
        )
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    ("words", "scaled"), [([], [0.5, -0.5, 0.25]), (["snapshot=10"], [0, 0, 0])]
)
def test_a_snapshot_becomes_a_file_in_the_units_of_the_plant(
    words: list[str],
    scaled: list[float],
    store: ArtifactStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "new" / "policy.pt2"
    assert door(store, monkeypatch, "run=bc/toy/seed0", f"to={path}", *words) == 0
    out = capsys.readouterr().out
    assert f"{path}: bc/toy/seed0 after {20 if not words else 10} updates; 240 actions in" in out
    low, high = np.array(BOUNDS).T
    action = FORMATS[".pt2"].read(path)({"history": np.zeros((1, 3, 6), np.float32)})
    # float32
    np.testing.assert_allclose(action[0], low + (np.array(scaled) + 1) / 2 * (high - low), 1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["to=a.onnx"], "run= is missing; write run=ID to=policy.onnx."),
        (["run=x"], "to= is missing; write run=ID to=policy.onnx."),
        (["run=x", "to=a.pkl"], "to=a.pkl must end in .onnx or .pt2."),
        (["run=x", "to=a.pt2", "to=b.pt2"], "to is given twice; give it once."),
        (["run=x", "to=a.pt2", "overwrite"], "'overwrite' has no value; write overwrite=true."),
        (["run=x", "to=a.pt2", "form=3"], "Unknown key 'form'; valid keys there: run, to"),
        (["run=x", "to=mlflow", "overwrite=true"], "overwrite=true is for files; MLflow keeps"),
        (["run=bc/toy/seed9", "to=a.pt2"], "holds no such finished run; give the id of a run"),
        ([f"run={DATA}", "to=a.pt2"], "is not a policy but a run of data_generation; give"),
        ([f"run={PLAIN}", "to=a.pt2", "snapshot=3"], f"snapshot=3: run={PLAIN} has none; it has"),
        ([f"run={PLAIN}", "to=there.pt2"], "to=there.pt2 exists; name another file, or"),
    ],
)
def test_refusals(
    words: list[str],
    message: str,
    store: ArtifactStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.pt2").touch()
    assert door(store, monkeypatch, *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["runs", "there.pt2"]


def test_an_older_format_and_a_missing_log_are_named(
    store: ArtifactStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (store.path(DATA) / "dataset" / "frames.npy").unlink()
    assert door(store, monkeypatch, f"run={PLAIN}", f"to={tmp_path / 'a.pt2'}") == 1
    assert "frames.npy is missing from its dataset" in capsys.readouterr().err
    card = store.path(PLAIN) / "policy" / "policy.json"
    card.write_text(card.read_text().replace("policy/2", "policy/1"))
    assert door(store, monkeypatch, f"run={PLAIN}", f"to={tmp_path / 'a.pt2'}") == 1
    assert "its format is 'policy/1'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [store.root]


LOAD = """
import mlflow, numpy as np
model = mlflow.pyfunc.load_model(sys.argv[1])
history = np.load(sys.argv[2])
print(json.dumps([model.predict(history).tolist(),
                  model.predict(history, params={"proximity": 1.0}).tolist()]))
"""


def served(model: Path, body: dict) -> tuple[int, dict]:
    """The answer of `mlflow models serve` to one request."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["--env-manager", "local", "--host", "127.0.0.1", "--port", str(port)]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # for its uvicorn
    server = subprocess.Popen(
        [sys.executable, "-m", "mlflow", "models", "serve", "--model-uri", str(model), *words],
        env=os.environ | {"PATH": path},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )

    def ask(method: str, place: str, text: str | None = None) -> tuple[int, str] | None:
        assert server.poll() is None, "the server has ended"
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        try:
            connection.request(method, place, text, {"Content-Type": "application/json"})
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        except ConnectionRefusedError:
            return None
        finally:
            connection.close()

    try:
        wait_for(lambda: ask("GET", "/ping"), "the server's answer")
        status, text = ask("POST", "/invocations", json.dumps(body)) or (0, "{}")
        return status, json.loads(text)
    finally:
        os.killpg(server.pid, signal.SIGTERM)
        server.wait()


@pytest.mark.slow(27)
def test_a_model_of_mlflow_has_a_signature_and_serves_without_this_project(
    store: ArtifactStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert door(store, monkeypatch, f"run={STEERED}", "to=mlflow") == 0
    for name in ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_ID"):
        assert name not in os.environ, "processes that are started later use what they did before"
    out = capsys.readouterr().out
    [model_id] = {word for word in out.split() if word.startswith("models:/")}
    assert f"mlflow models serve --model-uri {model_id} --env-manager local --host 127.0" in out
    client = import_mlflow().MlflowClient(f"sqlite:///{store.root}/mlflow.db")
    logged = client.get_logged_model(model_id.removeprefix("models:/"))
    assert logged.name == "lion_toy_seed0"
    assert logged.tags["key"] == STEERED
    folder = store.root / "artifacts" / "models" / logged.model_id / "artifacts"
    info = import_mlflow().models.Model.load(str(folder))
    assert info.signature.inputs.inputs[0].shape == (-1, 3, 6)
    assert info.signature.outputs.inputs[0].shape == (-1, 3)
    assert [(p.name, p.default) for p in info.signature.params] == [("proximity", 0.0)]
    assert info.saved_input_example_info["type"] == "ndarray"
    assert not list(folder.rglob("*.pkl"))

    histories = LOG.spread_histories(4, 3)
    np.save(tmp_path / "histories.npy", histories)
    hidden = ("components", "flows", "proximity_bench", "torch")
    found = json.loads(run_walled(LOAD, folder, tmp_path / "histories.npy", refused=hidden))
    low, high = np.array(BOUNDS).T
    wanted = []
    for proximity in (0.0, 1.0):
        scaled = steered().act(torch.from_numpy(histories)[None], torch.full((1, 4), proximity))[0]
        wanted.append(low + (scaled.numpy() + 1) / 2 * (high - low))
    np.testing.assert_allclose(found, wanted, rtol=1e-5)  # float32
    assert not np.allclose(wanted[0], wanted[1])

    body = {"inputs": histories.tolist(), "params": {"proximity": 1.0}}
    status, answer = served(folder, body)
    assert status == 200
    np.testing.assert_allclose(answer["predictions"], wanted[1], rtol=1e-5)
