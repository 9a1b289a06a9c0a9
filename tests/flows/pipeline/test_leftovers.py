"""What killed processes left in a store goes away, once no other process uses it."""

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from flows.pipeline.errors import StoreError
from flows.pipeline.leftovers import store_in_use
from flows.pipeline.locks import locked
from flows.pipeline.store import ArtifactStore

DEAD = (
    "progress/group.json",
    "progress/group.stop",
    "progress/.group.json-0123456789ab.json",
    "locks/.probe-123",
    "locks/0123",
    "reports/sweep/.results.csv-0123456789ab.csv",
    "arriving/key-0123456789ab",
    "arriving/key-0123456789ab.lock",
    "minari/.digests.json-0123456789ab.json",
    "work/group/.checkpoint.safetensors-0123456789ab.safetensors",
)
ALIVE = (
    "reports/sweep/results.csv",
    "work/group/checkpoint.safetensors",
    "work/group/members.json",
    "nodes/key/.keep-0123456789ab",
)


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    made = ArtifactStore(tmp_path)
    for name in (*DEAD, *ALIVE):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return made


def left(store: ArtifactStore, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if (store.root / name).exists()]


def test_leftovers_are_removed(store: ArtifactStore) -> None:
    arriving = store.root / "arriving" / "other-0123456789ab"
    arriving.mkdir()  # a reader of a shared store fills it, who has not the store in use
    lock = arriving.with_suffix(".lock")
    with locked(store.locks / "sweep"), locked(lock), store_in_use(store):
        assert (store.locks / "sweep").exists()  # held, if only by ourselves
        assert arriving.exists()
        assert left(store, DEAD) == []
        assert left(store, ALIVE) == list(ALIVE)


def test_beside_another_process_nothing_is_removed(store: ArtifactStore) -> None:
    hold = """
import sys
from flows.pipeline.leftovers import store_in_use
from flows.pipeline.store import ArtifactStore

with store_in_use(ArtifactStore(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""
    other = subprocess.Popen(
        [sys.executable, "-c", hold, str(store.root)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        for name in DEAD:
            (store.root / name).touch()
        with store_in_use(store):
            assert left(store, DEAD) == list(DEAD)
        other.kill()
    with store_in_use(store):
        assert left(store, DEAD) == []


def test_a_full_disk_leaves_no_probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> None:
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(StoreError, match="is full"):
        ArtifactStore(tmp_path)
    assert list((tmp_path / "locks").iterdir()) == []
