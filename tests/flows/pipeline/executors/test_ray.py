"""The real thing: Ray's processes, workers that die, a driver that is killed and started again."""

import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from components.core.files import read_json
from flows.command_line import make_executor
from flows.configuration.settings import load_settings
from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.executors.ray_driver import HOLD
from tests.flows.pipeline.toys import counted, diamond, node, wait_for


@pytest.mark.slow(10)
def test_ray_runs_a_plan_and_survives_its_workers(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """One start of Ray for all of this: starting it takes seconds."""
    log = tmp_path / "log"
    log.mkdir()
    (last,) = diamond(log)
    once = node("dies_once", "once", log, number=3)
    asked = node("terminated_once", "asked", log, number=3)
    always = node("dies_always", "always", log)
    lost = node("total", "lost", log, {"a": always})
    bad = node("fails", "bad", log, number=1)
    threads = node("threads", "threads", log, number=0)
    text = io.StringIO()
    outcome = run_plan(
        Plan([last, once, asked, lost, bad, threads]),
        store := ArtifactStore(tmp_path / "mlruns"),
        NullTracker(),
        Display(Console(file=text, width=200)),
        executor=RayExecutor(cpus=2, retries=2),
    )
    assert read_json(store.path(last.key) / "value.json") == 240.0
    assert read_json(store.path(once.key) / "value.json") == 3.0
    assert counted(log, "deaths-once") == 1
    assert "The worker of once died; starting again from the checkpoint." in text.getvalue()
    assert "The worker of asked died; starting again from the checkpoint." in text.getvalue()
    assert read_json(store.path(asked.key) / "value.json") == 3.0

    assert set(outcome.failed) == {always.key, bad.key}
    assert counted(log, "deaths-always") == 3
    assert "The worker of always died 3 times" in outcome.failed[always.key]
    assert "this toy fails on purpose" in outcome.failed[bad.key]
    assert outcome.skipped == {lost.key: always.key}
    assert outcome.exit_code == 1
    assert read_json(store.path(threads.key) / "value.json") == 1.0
    # Nothing of Ray's own talk reaches the screen, not even about dead workers.
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("cpus", "threads", "gpus", "share", "slots"),
    [
        (16, 1, 1, 0.5, 2),  # the GPU is the limit, not the sixteen processors
        (16, 1, 2, 0.4, 4),  # no task takes parts of two GPUs
        (16, 1, 1, 0.1, 10),
        (16, 6, 4, 1.0, 2),  # the processors are
    ],
)
def test_places_are_limited_by_processors_and_by_shares_of_gpus(
    cpus: int, threads: int, gpus: int, share: float, slots: int
) -> None:
    given = {"cpus": cpus, "threads": threads, "gpus": gpus, "gpus_per_task": share}
    assert RayExecutor(device="cuda", **given).slots == slots
    assert RayExecutor(device="cpu", **given).slots == max(1, cpus // threads)


def test_the_executor_of_a_door_knows_the_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 3)
    settings = load_settings(["profile=smoke", "runner.cpus=16", "runner.gpu_share=0.5"])
    assert make_executor(settings).slots == 6


def test_cluster_that_is_not_there_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "no address at all")
    executor = RayExecutor(cpus=1)
    with pytest.raises(PipelineError, match="RAY_ADDRESS=no address at all"):
        executor.start(lambda text: None)
    executor.stop()


def start_driver(home: Path, log: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tests.flows.pipeline.executors.ray_driver", str(home), str(log)],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"RAY_ADDRESS": ""},
        start_new_session=True,
        # As a terminal starts it: a shell's background jobs, such as a test run in CI may be,
        # inherit an ignored SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for Ray's own, short enough for sockets."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        yield Path(folder)


def child(process: subprocess.Popen[str], name: str) -> int:
    """The process id of a child with this program."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text(encoding="utf-8")
    (found,) = (
        int(number)
        for number in children.split()
        if Path(f"/proc/{number}/cmdline").read_bytes().split(b"\0")[0].endswith(name.encode())
    )
    return found


@pytest.mark.slow(25)
@pytest.mark.parametrize("victim", ["raylet", "gcs_server"])
def test_ray_that_dies_blames_no_node(victim: str, temporary: Path, tmp_path: Path) -> None:
    log, home = tmp_path / "log", tmp_path / "mlruns"
    log.mkdir()
    with start_driver(home, log) as driver:
        wait_for(lambda: counted(log, "holding") >= 2, "both groups to wait")
        os.kill(child(driver, victim), signal.SIGKILL)
        out, text = driver.communicate(timeout=60)
    assert (driver.returncode, out) == (1, ""), text
    last = text.splitlines()[-1]
    assert last.startswith("Ray is gone (")
    assert last.endswith("): give the same command again to continue.")
    assert "died" not in text
    assert not list(temporary.iterdir())
    experiment = MlflowTracker(home).experiment
    states = [(run.data.tags["role"], run.info.status) for run in experiment.search("")]
    assert sorted(states) == [("node", "FINISHED")] * 2 + [("sweep", "FAILED")]


@pytest.mark.slow(50)
def test_killed_driver_continues_to_the_same_result(temporary: Path, tmp_path: Path) -> None:
    log, home = tmp_path / "log", tmp_path / "mlruns"
    log.mkdir()
    plan = Plan(diamond(log, pause=0.2, hold=HOLD))
    store = ArtifactStore(home)

    def done() -> int:
        return sum(counted(log, f"step-s{i}0") for i in range(2))

    before: dict[str, int] = {}
    stops = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
    for attempt, number in enumerate(stops, start=1):
        with start_driver(home, log) as driver:
            wait_for(lambda n=attempt: counted(log, "drivers") == n, "the driver's start")
            if number == signal.SIGKILL:
                wait_for(lambda: done() >= 6, "six steps")
            else:  # both groups wait at the step HOLD, so the driver cannot be done already
                held = counted(log, "holding")
                wait_for(lambda n=held: counted(log, "holding") >= n + 2, "both groups to wait")
            names = [node.name for node in plan if store.path(node.key).is_dir()]
            before = {name: counted(log, f"finished-{name}") for name in names}
            if number == signal.SIGINT:
                os.killpg(driver.pid, number)  # as a terminal does it
            else:
                driver.send_signal(number)
            out, text = driver.communicate(timeout=60)
        if number == signal.SIGKILL:
            continue
        assert (driver.returncode, out) == (128 + number, ""), text
        # Ray's native code writes a stack, if it ends the process.
        assert "Interrupted; nothing finished is lost." in text.splitlines()[-1]
        assert "Traceback" not in text
        assert not list(temporary.iterdir())

    (log / "go").touch()
    with start_driver(home, log) as driver:
        out, text = driver.communicate(timeout=120)
    assert (driver.returncode, out) == (0, ""), text
    assert read_json(store.path(plan.nodes[-1].key) / "value.json") == 240.0
    assert {"n0", "n1"} <= set(before)
    assert {name: counted(log, f"finished-{name}") for name in before} == before
    # At most the step in progress at each of the stops is done again.
    assert 40 <= done() <= 46
    assert list(store.work.iterdir()) == []
    experiment = MlflowTracker(home).experiment
    runs = experiment.search("tags.role = 'node'")
    finished = [run.data.tags["key"] for run in runs if run.info.status == "FINISHED"]
    assert sorted(finished) == sorted(node.key for node in plan)
    (parent,) = experiment.search("tags.role = 'sweep'")
    assert parent.info.status == "FINISHED"


def test_a_silent_address_is_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound but not listening: nothing answers here
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        monkeypatch.setenv("RAY_ADDRESS", address)
        with pytest.raises(PipelineError, match=f"Nothing answers at RAY_ADDRESS={address}"):
            RayExecutor().start(print)


# Takes the place of this project's code on one of two machines that share all their folders.
_FOREIGN = """
import sys
from importlib.machinery import PathFinder

class Foreign:
    def find_spec(name, path=None, target=None):
        return PathFinder.find_spec(name, [{!r}]) if name in ("flows", "components") else None

sys.meta_path.insert(0, Foreign)
"""


@pytest.mark.slow(50)
def test_machines_of_a_cluster(tmp_path: Path) -> None:
    log, home, foreign = tmp_path / "log", tmp_path / "mlruns", tmp_path / "foreign"
    for folder in (log, foreign / "flows", foreign / "components"):
        folder.mkdir(parents=True)
    (foreign / "flows" / "__init__.py").touch()
    (foreign / "components" / "__init__.py").touch()
    (foreign / "sitecustomize.py").write_text(_FOREIGN.format(str(foreign)), encoding="utf-8")
    words = [sys.executable, "-m", "tests.flows.pipeline.executors.cluster_driver"]
    done = subprocess.run(
        [*words, str(home), str(log), str(foreign)],
        env=os.environ | {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"},  # not beyond this computer
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    other, threads, lost, end = done.stdout.splitlines()
    assert f"127.0.0.1 has other code in {foreign} than this computer in " in other
    assert other.count("127.0.0.1") == 1  # the other machine is as it should be
    assert threads.startswith("runner.threads=2, but a task can have no more than 1 of")
    assert lost.endswith(" is gone; starting again elsewhere.")
    assert end == "9 {}"
    assert not list((home / "locks").iterdir())
