"""Damage in a store: every file of an artifact, every way; found, named, and made again."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from components.core import integrity
from components.core.files import read_json, write_json
from components.core.integrity import DamagedFileError, describe_files
from components.core.sealed import RECORD, read_record, seal
from flows.pipeline import runner
from flows.pipeline.audit import Audit, audit
from flows.pipeline.errors import StoreError
from flows.pipeline.outcome import Outcome
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.file_tracker import FileTracker
from tests.flows.pipeline.damage import DAMAGES, damage
from tests.flows.pipeline.test_runner import Screen, run
from tests.flows.pipeline.toys import counted, node

FILES = (RECORD, "value.json", "metrics.json", "curves.npz", "datasets.json", "deep/blob.bin")


def chain(log: Path) -> list[Node]:
    """A number, a sum of it, a sum of that."""
    first = node("number", "first", log, number=3)
    second = node("total", "second", log, {"a": first})
    return [first, second, node("total", "third", log, {"a": second})]


def contents(store: ArtifactStore, one: Node) -> dict:
    return describe_files(store.path(one.key), leave_out=[RECORD])


@pytest.mark.parametrize("kind", DAMAGES)
@pytest.mark.parametrize("name", FILES)
def test_whatever_is_damaged_is_made_again_to_the_same_bytes(
    store: ArtifactStore, log: Path, name: str, kind: str
) -> None:
    nodes = chain(log)
    run(nodes, store)
    before = [contents(store, one) for one in nodes]
    damage(store.path(nodes[1].key) / name, kind)
    found = audit(Plan(nodes), store)
    assert found.finished == {nodes[0].key, nodes[2].key}

    screen = Screen()
    outcome = run(nodes, store, screen)
    assert (outcome.exit_code, outcome.finished) == (0, [nodes[1].key])
    assert [contents(store, one) for one in nodes] == before
    assert [counted(log, f"finished-{one.name}") for one in nodes] == [1, 2, 1]
    (line,) = [line for line in screen.text.splitlines() if "again" in line]
    assert line.startswith(f"{store.path(nodes[1].key) / name} is ")
    assert line.endswith(f"of toys second: it is made again (kept in damaged/{nodes[1].key}).")
    assert (store.damaged / nodes[1].key).is_dir()
    assert run(nodes, store).finished == []


def test_a_file_in_the_place_of_a_folder_is_set_aside(store: ArtifactStore, log: Path) -> None:
    nodes = chain(log)
    run(nodes, store)
    for _ in range(2):  # what was set aside before gives way
        shutil.rmtree(store.path(nodes[0].key))
        store.path(nodes[0].key).write_text("not a folder")
        screen = Screen()
        assert run(nodes, store, screen).exit_code == 0
        assert f"nodes/{nodes[0].key} is a file and should be a folder" in screen.text
        assert (store.damaged / nodes[0].key).read_text() == "not a folder"


def test_a_record_that_lacks_a_field_is_named(store: ArtifactStore, log: Path) -> None:
    nodes = chain(log)
    run(nodes, store)
    path = store.path(nodes[0].key)
    old = read_record(path)
    for name in ("files", "digest", "started", "content"):
        del old[name]
    write_json(path / RECORD, old)  # of an older version, which had no digests
    with pytest.raises(DamagedFileError, match=rf"{RECORD} lacks started; give the command"):
        store.record(nodes[0].key)
    assert run(nodes, store).finished == [nodes[0].key]


def test_refusing_names_file_node_and_remedy_and_changes_nothing(
    store: ArtifactStore, log: Path
) -> None:
    nodes = chain(log)
    run(nodes, store)
    path = store.path(nodes[1].key) / "value.json"
    damage(path, "flipped")
    before = describe_files(store.root)
    said = rf"^{path} is damaged .*, of toys second; .*runner\.repair=recompute"
    with pytest.raises(StoreError, match=said):
        run(nodes, store, repairs=False)
    assert describe_files(store.root) == before


def test_what_was_made_from_other_bytes_is_made_again(store: ArtifactStore, log: Path) -> None:
    nodes = chain(log)
    run(nodes, store)
    folder = store.path(nodes[0].key)
    write_json(folder / "value.json", 4.0)
    seal(folder, read_record(folder))  # sound, but not what the others have read
    found = audit(Plan(nodes), store)
    assert found.stale == found.unusable.keys() == {nodes[1].key}
    screen = Screen()
    outcome = run(nodes, store, screen)
    # The third has to be looked at when the second is there again.
    assert outcome.finished == [nodes[1].key, nodes[2].key]
    assert [read_json(store.path(one.key) / "value.json") for one in nodes] == [4.0, 4.0, 4.0]
    assert "was made from another 'a' than there is now, of toys second" in screen.text
    assert outcome.exit_code == 0
    assert run(nodes, store).finished == []
    write_json(folder / "value.json", 5.0)
    seal(folder, read_record(folder))
    with pytest.raises(StoreError, match="made from another 'a'"):
        run(nodes, store, repairs=False)


def test_an_artifact_that_was_deleted_is_made_again_and_its_dependents_are_compared(
    store: ArtifactStore, log: Path
) -> None:
    first = node("number_of_a_file", "first", log)
    last = node("total", "last", log, {"a": first})
    (log / "number").write_text("3")
    run([last], store)
    (log / "number").write_text("5")
    shutil.rmtree(store.path(first.key))
    assert run([last], store).finished == [first.key, last.key]
    assert read_json(store.path(last.key) / "value.json") == 5.0


def test_artifacts_of_an_older_version_are_reused_and_counted(
    store: ArtifactStore, log: Path
) -> None:
    nodes = chain(log)
    run(nodes, store)
    for one in nodes[:2]:
        folder = store.path(one.key)
        old = {k: v for k, v in read_record(folder).items() if k not in ("files", "digest")}
        write_json(folder / RECORD, old)
    screen = Screen()
    screen.show_plan(Plan(nodes), store, 1)
    assert "All 3 nodes are finished." in screen.text
    assert "2 finished artifacts carry no digests and cannot be checked" in screen.text
    assert run(nodes, store).finished == []
    # They say what they can: here the third knows what it has read.
    write_json(store.path(nodes[1].key) / "value.json", 9.0)
    assert run(nodes, store).finished == [nodes[2].key]


class Meddling(FileTracker):
    """Damages a file when a node is recorded."""

    def __init__(self, root: Path, what: Callable[[Node], None]) -> None:
        super().__init__(root)
        self.what = what

    def log_node(self, node: Node, folder: Path) -> None:
        self.what(node)
        super().log_node(node, folder)


def run_with(what: Callable[[Node], None], nodes: list[Node], store: ArtifactStore) -> Outcome:
    tracker = Meddling(store.root, what)
    tracker.open("sweep")
    try:
        return run(nodes, store, None, tracker)
    finally:
        tracker.close("FINISHED")


def test_damage_during_a_run_is_made_good_in_it(store: ArtifactStore, log: Path) -> None:
    nodes = chain(log)
    left = [1]

    def flip_the_first(one: Node) -> None:
        if one.name == "first" and left:
            left.pop()
            damage(store.path(one.key) / "value.json", "flipped")

    outcome = run_with(flip_the_first, nodes, store)
    assert (outcome.exit_code, len(outcome.finished)) == (0, 3)
    assert counted(log, "finished-first") == 2
    assert read_json(store.path(nodes[2].key) / "value.json") == 3.0


def test_what_another_driver_makes_between_two_passes_is_taken_and_recorded(
    store: ArtifactStore, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = chain(log)
    recorded = []
    looks = []

    def flip_the_first(one: Node) -> None:
        recorded.append(one.name)
        if recorded == ["first"]:
            damage(store.path(one.key) / "value.json", "flipped")

    def look(*given: Any) -> Audit:
        looks.append(given)
        if len(looks) == 2:  # the second is postponed now
            assert run(nodes[:2], store).exit_code == 0
        return audit(*given)

    monkeypatch.setattr(runner, "audit", look)
    outcome = run_with(flip_the_first, nodes, store)
    assert outcome.exit_code == 0
    assert sorted(outcome.finished) == sorted(one.key for one in nodes)
    assert set(recorded) == {"first", "second", "third"}
    assert [counted(log, f"finished-{one.name}") for one in nodes] == [2, 1, 1]


def test_a_disk_that_damages_for_ever_ends_in_a_sentence(store: ArtifactStore, log: Path) -> None:
    nodes = chain(log)

    def flip_the_first(one: Node) -> None:
        if one.name == "first" and store.path(one.key).is_dir():
            damage(store.path(one.key) / "value.json", "flipped")

    outcome = run_with(flip_the_first, nodes, store)
    assert outcome.exit_code == 1
    assert "3 times in this run: check the disk" in outcome.failed[nodes[0].key]
    assert outcome.skipped == {one.key: nodes[0].key for one in nodes[1:]}
    assert counted(log, "finished-first") == 3
    assert counted(log, "finished-second") == 0


def test_a_sound_input_that_its_reader_cannot_use_is_not_blamed_on_the_disk(
    store: ArtifactStore, log: Path
) -> None:
    first = node("number", "first", log, number=3)
    last = node("cannot_read", "last", log, {"a": first})
    outcome = run([first, last], store)
    assert outcome.exit_code == 1
    (reason,) = outcome.failed.values()
    assert f"{store.path(first.key)}/value.json is no policy, 3 times in this run" in reason
    assert "what was written: whoever reads them expects others. If no setting explains" in reason
    assert "disk" not in reason
    assert store.complete(first.key)
    assert counted(log, "finished-first") == 1


def test_damage_that_only_the_reader_sees_is_read_again_before_it_is_believed(
    store: ArtifactStore, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A large file whose damage leaves no trace in its times; another process has met it."""
    monkeypatch.setattr(integrity, "SMALL", 0)
    nodes = chain(log)
    run(nodes[:1], store)
    path = store.path(nodes[0].key) / "value.json"
    run(nodes[:1], store)  # reads it
    when = path.stat().st_mtime_ns
    path.write_bytes(path.read_bytes().replace(b"3", b"4"))
    os.utime(path, ns=(when, when))
    assert audit(Plan(nodes), store).finished  # this process has read it before
    found = audit(Plan(nodes), store, {nodes[0].key: "somebody says so"})
    assert list(found.unusable) == [nodes[0].key]


def test_an_artifact_that_the_tracker_cannot_read_does_not_stop_the_others(
    store: ArtifactStore, log: Path
) -> None:
    nodes = [node("number", f"n{i}", log, number=i) for i in range(4)]

    def flip_the_second(one: Node) -> None:
        if one.name == "n1":
            damage(store.path(one.key) / "metrics.json", "flipped")

    tracker = Meddling(store.root, flip_the_second)
    tracker.open("sweep")
    screen = Screen()
    outcome = run(nodes, store, screen, tracker, repairs=False)
    recorded = [event["name"] for event in tracker.file.newest() if event["event"] == "node"]
    tracker.close("FINISHED")
    assert sorted(recorded) == ["n0", "n2", "n3"]
    assert (outcome.exit_code, outcome.status, outcome.unrecorded) == (1, "FINISHED", "")
    (said,) = outcome.damaged.values()
    assert said.startswith(f"{store.path(nodes[1].key)}/metrics.json is damaged")
    assert said in screen.text


@pytest.mark.parametrize("kind", [*DAMAGES, "foreign"])
def test_work_that_cannot_be_continued_is_begun_anew(
    store: ArtifactStore, log: Path, kind: str
) -> None:
    one = node("checked_steps", "s", log, number=1, steps=6, hold=3)
    assert run([one], store).exit_code == 1
    (work,) = store.work.iterdir()
    damage(work / "checkpoint.safetensors", kind)
    (log / "go").touch()
    screen = Screen()
    if kind == "missing":  # nothing says that there was one
        assert run([one], store, screen).exit_code == 0
        return
    refused = run([one], store, repairs=False)
    assert "checkpoint.safetensors" in refused.failed[one.key].splitlines()[-1]
    assert "runner.repair=recompute" in refused.failed[one.key].splitlines()[-1]
    assert run([one], store, screen).exit_code == 0
    (line,) = [line for line in screen.text.splitlines() if "begins anew" in line]
    assert line.startswith(f"{work}/checkpoint.safetensors is damaged")
    assert read_json(store.path(one.key) / "value.json") == 6.0
    assert list(store.work.iterdir()) == []


def test_a_folder_in_the_place_of_a_checkpoint_is_begun_anew(
    store: ArtifactStore, log: Path
) -> None:
    one = node("checked_steps", "s", log, number=1, steps=6, hold=3)
    assert run([one], store).exit_code == 1
    (work,) = store.work.iterdir()
    (work / "checkpoint.safetensors").unlink()
    (work / "checkpoint.safetensors" / "mine").mkdir(parents=True)
    (log / "go").touch()
    screen = Screen()
    assert run([one], store, screen).exit_code == 0
    assert "checkpoint.safetensors is a folder: " in screen.text


@pytest.mark.parametrize("content", [None, "{", "[]", '{"members": 3, "serves": []}', "{}"])
def test_a_work_folder_without_its_members_does_not_stay(
    store: ArtifactStore, log: Path, content: str | None
) -> None:
    one = node("steps", "s", log, number=1, steps=6, hold=3, patience=0.0)
    run([one], store)
    (work,) = store.work.iterdir()
    (work / "members.json").unlink()
    if content is not None:
        (work / "members.json").write_text(content)
    (log / "go").touch()
    screen = Screen()
    assert run([one], store, screen).exit_code == 0
    assert f"{work} is removed, since its members.json is missing or damaged" in screen.text
    assert list(store.work.iterdir()) == []


def test_outputs_that_a_power_cut_has_damaged_are_made_again(
    store: ArtifactStore, log: Path
) -> None:
    one = node("number", "n", log, number=1)
    work = store.open_work([one.key])
    store.fresh_out(work, [one.key])
    (work.out(one.key) / "value.json").write_text("1.0")
    seal(work.out(one.key), {"key": one.key})
    store.mark_ready(work, [one.key])
    (work.out(one.key) / "value.json").write_text("")
    outcome = run([one], store)
    assert (outcome.exit_code, outcome.finished) == (0, [one.key])
    assert read_json(store.path(one.key) / "value.json") == 1.0
    assert list(store.work.iterdir()) == []
