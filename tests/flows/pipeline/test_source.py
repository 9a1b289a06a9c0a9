"""Records name the code behind a number, and code that has changed under its version is named."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from flows.pipeline import source
from flows.pipeline.audit import audit
from flows.pipeline.plan import Plan
from flows.pipeline.source import COMMIT, code_digest, commit
from flows.pipeline.store import ArtifactStore
from flows.planning.nodes import model_node
from tests.flows.pipeline.test_runner import Screen, run
from tests.flows.pipeline.toys import node

PLAIN = '"""Learns."""\ndef update(step):\n    """One update."""\n    return 2 * step\n'


@pytest.fixture(autouse=True)
def forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv(COMMIT, raising=False)
    for known in (commit, source._code):
        known.cache_clear()
    yield
    for known in (commit, source._code):
        known.cache_clear()


def digest_of(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    file = folder / f"own{len(list(folder.iterdir()))}.py"  # inspect remembers files
    file.write_text(text, encoding="utf-8")
    module = ModuleType("own_learner")
    module.__file__ = str(file)
    monkeypatch.setitem(sys.modules, "own_learner", module)
    source._code.cache_clear()
    return code_digest(["own_learner"])


def test_a_digest_is_of_what_code_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = digest_of(PLAIN, tmp_path, monkeypatch)
    assert plain.startswith(f"3.{sys.version_info.minor}:")
    for same in (PLAIN.replace("One update.", "An update."), "# comment\n\n" + PLAIN):
        assert digest_of(same, tmp_path, monkeypatch) == plain
    for other in (PLAIN.replace("2 *", "3 *"), PLAIN + "\nRATE = 3\n"):
        assert digest_of(other, tmp_path, monkeypatch) != plain


def test_code_without_source_has_no_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "compiled", ModuleType("compiled"))
    assert code_digest(["compiled"]) == ""


def repository(folder: Path) -> Path:
    """A repository whose one file is where this module would lie in it."""
    file = folder / "flows" / "pipeline" / "source.py"
    file.parent.mkdir(parents=True)
    file.write_text("x = 1\n", encoding="utf-8")
    who = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    for words in (("init", "-q"), ("add", "."), (*who, "commit", "-q", "-m", "first")):
        subprocess.run(["git", *words], cwd=folder, check=True)
    return file


def test_the_commit_says_whether_files_differ_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = repository(tmp_path)
    monkeypatch.setattr(source, "__file__", str(file))
    monkeypatch.setattr(source, "_ROOT", tmp_path)
    clean = commit()
    assert len(clean) == 40
    (tmp_path / "results.csv").write_text("1\n", encoding="utf-8")
    commit.cache_clear()
    assert commit() == clean, "no code"
    (tmp_path / "flows" / "own.py").write_text("y = 1\n", encoding="utf-8")
    commit.cache_clear()
    assert commit() == f"{clean}+changes"


def test_an_installed_copy_has_not_the_commit_of_the_repository_around_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = repository(tmp_path).parent / "installed.py"
    file.write_text("x = 1\n", encoding="utf-8")
    monkeypatch.setattr(source, "__file__", str(file))
    monkeypatch.setattr(source, "_ROOT", tmp_path)
    assert commit() == ""
    monkeypatch.setenv(COMMIT, "abc")  # as a machine is told that has no repository
    commit.cache_clear()
    assert commit() == "abc"


def test_results_of_other_code_are_used_and_named(store: ArtifactStore, log: Path) -> None:
    first = replace(node("number", "first", log, number=3), code="3.11:aa", tags={"model": "toy"})
    run([first], store)
    record = store.record(first.key)
    assert record["code"] == "3.11:aa"
    assert record["commit"] == commit()
    assert audit(Plan([first]), store).other_code == {}

    changed = replace(first, code="3.11:bb")
    assert changed.key == first.key
    found = audit(Plan([changed]), store)
    assert (found.finished, found.other_code) == ({first.key}, {"toys of toy": 1})
    screen = Screen()
    screen.show_plan(Plan([changed]), store, 1, found, "cpu")
    assert "used all the same: toys of toy (1). If the change" in screen.text

    for unknown in ("3.12:bb", ""):  # another parser's, or without source
        assert audit(Plan([replace(first, code=unknown)]), store).other_code == {}


def test_trained_nodes_tell_their_code() -> None:
    from components.data.sizes import DataSizes
    from components.models import MODELS

    data = node("number", "data", Path("log"), number=1)
    digests = {
        name: model_node(name, kind.config(), "toy", data, DataSizes()).code
        for name, kind in MODELS.items()
    }
    assert all(digests.values())
    assert digests["behaviour_policy"] != digests["recurrent_ensemble"]
