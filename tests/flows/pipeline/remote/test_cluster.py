"""Two machines that share nothing but an S3 server, one of which dies; and clusters of others."""

import contextlib
import os
import secrets
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.pipeline.plan import Plan
from flows.pipeline.remote.objects import Objects
from flows.pipeline.remote.places import CACHE
from flows.pipeline.remote.shared_store import SharedStore
from tests.conftest import ROOT
from tests.flows.pipeline.remote.apart_driver import HOLD
from tests.flows.pipeline.remote.conftest import bucket, free_port
from tests.flows.pipeline.toys import counted, diamond, wait_for

Environment = dict[str, str]
OTHER_PYTHON = """
import json, sys
from ray._common.usage.usage_constants import CLUSTER_METADATA_KEY as KEY
from ray._private.ray_constants import KV_NAMESPACE_CLUSTER as PLACE
from ray._raylet import GcsClient
client = GcsClient(address=sys.argv[1])
told = json.loads(client.internal_kv_get(KEY, PLACE)) | {"python_version": sys.argv[2]}
client.internal_kv_put(KEY, json.dumps(told).encode(), True, PLACE)
"""


class Machines:
    """A Ray cluster whose machines are started and killed by this test."""

    def __init__(self, home: Path, environment: Environment) -> None:
        self.address = f"127.0.0.1:{free_port()}"
        self.environment = environment
        self._home = home
        self._machines: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str) -> None:
        """Starts a machine with a working folder and a copy of its own, and waits for it."""
        folder = self._home / name
        folder.mkdir()
        told = folder / "told"
        port = self.address.rpartition(":")[2]
        words = ["--address", self.address]
        if not self._machines:
            words = ["--head", "--port", port, "--include-dashboard=false"]
            words += ["--temp-dir", str(self._home / "r")]
        words += ["--node-ip-address", "127.0.0.1", "--num-cpus", "1"]
        words += ["--object-store-memory", str(100 * 2**20)]
        with told.open("wb") as out:
            self._machines[name] = subprocess.Popen(
                [Path(sys.executable).with_name("ray"), "start", "--block", *words],
                cwd=folder,
                env=self.environment | {"HOME": str(folder), CACHE: str(folder / "cache")},
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        wait_for(lambda: b"Ray runtime started" in told.read_bytes(), f"the machine {name}")

    def kill(self, name: str) -> None:
        """Ends all processes of a machine at once, as a power cut does."""
        machine = self._machines.pop(name)
        for process in _family(machine.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        machine.wait()

    def run(self, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        """Runs Python on the driver's machine."""
        with self.begin(*words, **environment) as begun:
            out, text = begun.communicate()
        return subprocess.CompletedProcess(words, begun.returncode, out, text)

    def begin(self, *words: str, **environment: str) -> "subprocess.Popen[str]":
        """Begins it."""
        (self._home / "driver").mkdir(exist_ok=True)
        here = {"HOME": str(self._home / "driver"), CACHE: str(self._home / "driver" / "cache")}
        whole = self.environment | here | {"RAY_ADDRESS": self.address} | environment
        return subprocess.Popen(
            [sys.executable, *words],
            cwd=ROOT,
            env={name: value for name, value in whole.items() if value},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )


def _family(process: int) -> list[int]:
    with contextlib.suppress(OSError):
        found = Path(f"/proc/{process}/task/{process}/children").read_text(encoding="utf-8")
        return [process, *(p for child in found.split() for p in _family(int(child)))]
    return [process]


@pytest.fixture
def machines(s3: Environment) -> Iterator[Machines]:
    """No machine yet; all that were started end with the test."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "MLFLOW_TRACKING_URI") and not name.startswith("RAY_")
    }
    secret = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(20)}
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # short, for Ray's sockets
        found = Machines(Path(folder), kept | s3 | secret | {"RAY_USAGE_STATS_ENABLED": "0"})
        try:
            yield found
        finally:
            for name in list(found._machines):
                found.kill(name)


@pytest.mark.slow(60)
def test_what_a_machine_had_begun_goes_on_where_nothing_is_shared(
    machines: Machines, s3: Environment, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One start of two machines for all of this: starting them takes seconds."""
    url = bucket(s3, monkeypatch)
    machines.start("first")
    machines.start("second")
    driver = machines.begin("-m", "tests.flows.pipeline.remote.apart_driver", url, str(log))
    wait_for(lambda: driver.poll() is not None or counted(log, "holding") >= 2, "both groups")

    monkeypatch.setenv(CACHE, str(tmp_path / "looking"))
    looking = SharedStore(url)

    def saved() -> bool:
        steps = [_step(looking.objects, name) for name in looking.objects.sizes("work")]
        return steps.count(HOLD) == 2

    wait_for(lambda: driver.poll() is not None or saved(), "both checkpoints in the store")
    machines.kill("second")
    (log / "go").touch()
    out, text = driver.communicate(timeout=300)
    assert (driver.returncode, out) == (0, ""), text
    assert "The machine of s" in text
    assert " is gone; starting again elsewhere." in text

    plan = Plan(diamond(log, hold=HOLD))
    (last,) = (node for node in plan if node.name == "sum")
    looking.fetch(node.key for node in plan)
    assert (looking.path(last.key) / "value.json").read_text() == "240.0"
    # Every step was taken once: nothing that was finished was lost, nothing was done twice.
    lanes = [node.name for node in plan if node.component == "train"]
    assert {counted(log, f"step-{name}") for name in lanes} == {20}
    assert all(counted(log, f"finished-{node.name}") == 1 for node in plan)
    assert {looking.record(n.key)["resumed"] for n in plan if n.component == "train"} == {
        True,
        False,
    }
    left = [name for part in ("locks", "work", "progress") for name in looking.objects.sizes(part)]
    assert left == []

    again = machines.run("-m", "tests.flows.pipeline.remote.apart_driver", url, str(log))
    assert again.returncode == 0, again.stderr
    assert all(counted(log, f"finished-{node.name}") == 1 for node in plan)
    _clusters_of_others(machines, url, log)


def _step(objects: Objects, name: str) -> int | None:
    """The step of a checkpoint of the toys, None for any other file."""
    content = objects.read(name) or b""
    found = content.partition(b'"step": ')[2].partition(b",")[0]
    return int(found) if found.isdigit() else None


def _clusters_of_others(machines: Machines, url: str, log: Path) -> None:
    words = ("-m", "tests.flows.pipeline.remote.apart_driver", f"{url}-2", str(log))
    for token, why in (
        ({"RAY_AUTH_TOKEN": "f" * 40}, "the one in RAY_AUTH_TOKEN is not it"),
        (
            {"RAY_AUTH_TOKEN": "", "RAY_AUTH_MODE": ""},
            "this command has none",
        ),
    ):
        refused = machines.run(*words, **token)
        assert refused.returncode == 1
        said = refused.stderr.splitlines()[-1]
        assert said.startswith(f"The cluster at RAY_ADDRESS={machines.address} asks for a token, ")
        assert why in said
        assert "RAY_AUTH_TOKEN_PATH" in said
        assert "InvalidAuthToken" not in refused.stderr
    machines.run("-c", OTHER_PYTHON, machines.address, "3.99.1")
    refused = machines.run(*words)
    said = refused.stderr.splitlines()[-1]
    assert f"RAY_ADDRESS={machines.address} runs Python 3.99.1, this command Python " in said
