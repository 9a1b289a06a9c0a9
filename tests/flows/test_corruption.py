"""The corruption table: every file of every kind of artifact, damaged in every way, is named."""

import shutil
import sys
from pathlib import Path

import pytest

from components.core.integrity import SMALL, DamagedFileError, describe_files
from components.core.sealed import RECORD, read_record
from flows.command_line import main
from flows.full_benchmark import HELP, _run
from flows.pipeline.store import ArtifactStore
from tests.conftest import SmokeRun
from tests.flows.pipeline.damage import DAMAGES, damage

COMPONENTS = {"data_generation", "model_fitting", "policy_training", "evaluation", "aggregation"}


def kinds(store: ArtifactStore) -> dict[str, str]:
    """A node of every kind by name: components, and what they make of what."""
    found: dict[str, str] = {}
    for record in store.records():
        made = record["config"].get("model") or record["config"].get("algorithm", "")
        found.setdefault(f"{record['component']}/{made}".rstrip("/"), record["key"])
    return found


@pytest.mark.slow(20)
@pytest.mark.parametrize("kind", DAMAGES)
def test_no_damage_of_any_file_of_any_artifact_is_silent(
    smoke: SmokeRun, tmp_path: Path, kind: str
) -> None:
    source, copy = ArtifactStore(smoke.store, create=False), ArtifactStore(tmp_path / "mlruns")
    found = kinds(source)
    assert {name.partition("/")[0] for name in found} == COMPONENTS
    assert len(found) > 30  # every model fitted, every algorithm trained and aggregated
    for key in found.values():
        folder = copy.path(key)
        shutil.copytree(source.path(key), folder)
        record = copy.check(key)
        assert record["content"].keys() == record["inputs"].keys()
        assert None not in record["content"].values()
        files = [path for path in folder.rglob("*") if path.is_file()]
        assert {path.relative_to(folder).as_posix() for path in files} == {
            *record["files"],
            RECORD,
        }
        for path in files:
            damage(path, kind)
            # A new store, as in another process: this one knows the record already.
            with pytest.raises(DamagedFileError, match=r"is damaged|is missing") as caught:
                ArtifactStore(copy.root).check(key)
            assert caught.value.path == path
            # With its time: written twice within a tick of the clock, it would look the same.
            shutil.copy2(source.path(key) / path.relative_to(folder), path)
        assert read_record(folder) == record
        shutil.rmtree(folder)


WORDS = ("profile=smoke", "datasets=[bad-0.4]", "algorithms=[bc]", "seeds=[0]", "sweep=small")
RUNNER = ("runner.executor=serial", "runner.tracker=file")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of the smallest sweep."""
    store = tmp_path_factory.mktemp("small") / "mlruns"
    with pytest.MonkeyPatch.context() as patch:
        assert door(patch, store) == 0
    return store


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(made, tmp_path / "mlruns"))


def door(monkeypatch: pytest.MonkeyPatch, store: Path, *words: str) -> int:
    """The exit code of the benchmark's door."""
    monkeypatch.setattr(sys, "argv", ["full_benchmark", *WORDS, *RUNNER, f"store={store}", *words])
    with pytest.raises(SystemExit) as ended:
        main("full_benchmark", HELP, _run)
    return int(ended.value.code or 0)


def results(store: Path) -> dict[str, dict[str, str]]:
    """Digests of everything that a sweep has made, the records of its course left out."""
    # shown.json names the runs that a report was written from, which are others now.
    reports = {
        name: told["sha256"]
        for name, told in describe_files(store / "reports").items()
        if not name.endswith("shown.json")
    }
    nodes = describe_files(store / "nodes")
    files = {name: told["sha256"] for name, told in nodes.items() if not name.endswith(RECORD)}
    return {"reports": reports, "nodes": files}


# By a file that only one artifact of this sweep has, the name of its node.
OWNERS = {
    "summary.json": "aggregation aggregate/bc/bad-0.4",
    "returns.npz": "evaluation evaluate/bc/bad-0.4/seed0",
    "policy/weights.safetensors": "policy_training bc/bad-0.4/seed0",
    "model/policy.json": "model_fitting behaviour_policy/bad-0.4",
    "dataset/card.json": "data_generation data/bad-0.4",
    "dataset/frames.npy": "data_generation data/bad-0.4",
}


@pytest.mark.slow(20)
@pytest.mark.parametrize("name", OWNERS)
def test_a_damaged_artifact_is_made_again_or_refused(
    made: Path,
    store: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    (path,) = (store / "nodes").glob(f"*/{name}")
    damage(path, "flipped")
    before = describe_files(store)

    assert door(monkeypatch, store, "repair=refuse") == 1
    printed = capsys.readouterr()
    said = f"{path} is damaged (its content is not what was written), of {OWNERS[name]}"
    line = printed.err.splitlines()[-1]
    assert line.startswith(f"full_benchmark: {said}; runner.repair=refuse leaves it as it is")
    assert "Traceback" not in printed.err
    assert describe_files(store) == before

    # Large files are read where somebody needs them: here by a node that is not there.
    if path.stat().st_size > SMALL:
        for lost in store.glob("nodes/*/policy"):
            shutil.rmtree(lost.parent)
        before = describe_files(store)
    assert door(monkeypatch, store, "dry_run=true") == 0
    assert f"{said}: it is made again." in capsys.readouterr().out
    assert describe_files(store) == before

    assert door(monkeypatch, store) == 0
    assert f"{said}: it is made again (kept in damaged/" in capsys.readouterr().err
    assert results(store) == results(made)
