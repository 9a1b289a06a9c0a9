"""Artifacts appear whole, work survives, and a disk that cannot be used says so."""

import errno
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from components.core.files import read_json, write_json
from components.core.integrity import DamagedFileError
from components.core.sealed import seal
from flows.pipeline.errors import StoreError
from flows.pipeline.locks import locked
from flows.pipeline.store import ArtifactStore, disk_error_message
from tests.flows.pipeline.toys import record_of

A, B, C = (letter * 32 for letter in "abc")


def make(store: ArtifactStore, key: str) -> None:
    folder = store.work / f"made-{key}"
    folder.mkdir()
    seal(folder, record_of(key))
    store.publish(folder, key)


def test_publishing_twice_keeps_the_first_and_leaves_nothing_behind(store: ArtifactStore) -> None:
    make(store, A)
    (store.path(A) / "first").touch()
    make(store, A)
    assert store.complete(A)
    assert (store.path(A) / "first").exists()
    assert list(store.work.iterdir()) == []


def test_damaged_artifact_is_unfinished_and_named_with_the_remedy(store: ArtifactStore) -> None:
    make(store, A)
    (store.path(A) / "node.json").write_text("{half")
    assert not store.complete(A)
    assert list(store.records()) == []
    with pytest.raises(DamagedFileError, match=f"{A}.*node.json is damaged.*; give the command"):
        store.record(A)


def test_folder_that_is_a_file_is_refused_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "mlruns").write_text("not a folder")
    with pytest.raises(StoreError, match=r"mlruns cannot be written.*choose another"):
        ArtifactStore(tmp_path / "mlruns")


def test_full_disk_is_named(tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(OSError, match="No space") as caught, full.open("w") as file:
        file.write("x")
    assert "is full: free space" in str(disk_error_message(caught.value, tmp_path))
    assert disk_error_message(OSError(errno.EIO, "broken"), tmp_path) is None


def test_reading_store_makes_no_folder(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "mlruns", create=False)
    assert not store.complete(A)
    assert list(store.records()) == []
    assert store.split([A, B]) == [[A, B]]
    assert not (tmp_path / "mlruns").exists()


def test_work_is_found_again_by_what_it_still_has_to_do(store: ArtifactStore) -> None:
    work = store.open_work([A, B, C])
    (work.path / "checkpoint").write_text("half")
    assert store.open_work([C, B, A]).path == work.path
    make(store, B)
    again = store.open_work([A, C])
    assert again.path == work.path
    assert again.members == (A, B, C)
    assert again.resumed


def test_work_that_another_process_removes_meanwhile_is_passed_over(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, kept = store.open_work([A]), store.open_work([B])

    def read_and_lose(path: Path) -> Any:
        content = read_json(path)
        if path.parent == gone.path:
            store.discard(gone)
        return content

    monkeypatch.setattr("flows.pipeline.work.read_json", read_and_lose)
    assert store.work_folders() == [kept]


def test_part_of_begun_work_continues_on_a_copy(store: ArtifactStore) -> None:
    work = store.open_work([A, B, C])
    (work.path / "checkpoint").write_text("half")
    copy = store.open_work([A])
    assert copy.path != work.path
    assert copy.members == (A, B, C)
    assert (copy.path / "checkpoint").read_text() == "half"
    # The whole is still there for a call that needs the rest, or all.
    assert store.split([A, B, C]) == [[A, B, C]]
    assert store.open_work([A, B, C]).path == work.path


def test_more_lanes_than_before_leave_begun_work_together(store: ArtifactStore) -> None:
    (store.open_work([A, B]).path / "checkpoint").touch()
    assert store.split([C, A, B]) == [[A, B], [C]]


def test_repair_publishes_what_was_ready_and_removes_what_is_over(store: ArtifactStore) -> None:
    work = store.open_work([A, B])
    store.fresh_out(work, [A, B])
    for key in (A, B):
        seal(work.out(key), record_of(key))
    store.mark_ready(work, [A, B])
    store.publish(work.out(A), A)  # ... and here the process was killed
    store.repair()
    assert store.complete(A)
    assert store.complete(B)
    assert list(store.work.iterdir()) == []
    assert list(store.locks.iterdir()) == []


def test_repair_leaves_held_work_and_checkpoints_alone(store: ArtifactStore) -> None:
    held, begun, empty = (store.open_work([key]) for key in (A, B, C))
    (begun.path / "checkpoint").touch()
    script = (
        "import sys; from flows.pipeline.store import ArtifactStore as S\n"
        "with S(sys.argv[1]).locked([sys.argv[2]]): print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", script, str(store.root), A]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        store.repair()
        with store.locked([A, B], wait=False) as free:
            assert not free
        other.kill()
    assert held.path.exists()
    assert begun.path.exists()
    assert not empty.path.exists()
    with store.locked([A, B], wait=False) as free:
        assert free  # the kernel gave the lock back


def test_a_lock_file_removed_by_its_holder_does_not_block_the_next(tmp_path: Path) -> None:
    with locked(tmp_path / "lock") as first:
        assert first
        with locked(tmp_path / "lock", wait=False) as second:
            assert not second
    assert not (tmp_path / "lock").exists()
    with locked(tmp_path / "lock", wait=False) as third:
        assert third


def test_json_files_are_whole_or_absent(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"x": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"x": object()})
    assert read_json(tmp_path / "a.json") == {"x": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert read_json(tmp_path / "missing.json") is None
