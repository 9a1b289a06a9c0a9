"""Journals of studies that a kill, a disk or a person has damaged."""

import json
import re
import subprocess
from pathlib import Path

import pytest

from flows.pipeline.errors import PipelineError
from flows.tuning.journal import journal_path, open_journal
from tests.flows.pipeline.toys import counted
from tests.flows.tuning.toys import run, study


@pytest.fixture
def log(tmp_path: Path) -> Path:
    folder = tmp_path / "log"
    folder.mkdir()
    return folder


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "feature%2F ö?"  # no address is made of it


def lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


def test_every_cut_through_the_last_line_keeps_the_changes_before_it(home: Path, log: Path) -> None:
    run(home, log, 2)
    path = journal_path(home)
    *whole, last = lines(path)
    assert path == home / "optuna" / "journal.log"
    for cut in range(1, len(last) - 1):
        path.write_bytes(b"".join(whole) + last[:cut])
        open_journal(path)
        assert lines(path) == whole
    path.write_bytes(b"".join(whole) + last[:-1])  # only its end is lacking
    open_journal(path)
    assert lines(path) == [*whole, last]


def test_a_search_goes_on_after_a_cut(home: Path, log: Path) -> None:
    run(home, log, 3)
    path = journal_path(home)
    path.write_bytes(path.read_bytes()[:-20])
    assert run(home, log, 3).exit_code == 0
    assert study(home, log).ended == 3


@pytest.mark.parametrize(
    "damaged",
    [b"garbage", b"", b'{"op_code": 4, "wor', b'"text"', b"[1]", b'{"mine": 1}', b"\x00\xff\x80"],
)
@pytest.mark.parametrize("at", [0, 3, -1], ids=["first", "middle", "last"])
def test_a_damaged_line_is_named_and_nothing_is_lost(
    home: Path, log: Path, damaged: bytes, at: int
) -> None:
    run(home, log, 1)
    path = journal_path(home)
    content = lines(path)
    content[at] = damaged + b"\n"
    path.write_bytes(b"".join(content))
    before = path.read_bytes()
    with pytest.raises(PipelineError) as caught:
        run(home, log, 1)
    number = at + 1 if at >= 0 else len(content)
    message = str(caught.value)
    assert message.startswith(f"Line {number} of the journal {path} is damaged: set the file aside")
    assert ("head -n" in message) == (number > 1)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "content",
    [
        bytes(range(256)) * 4,
        b"SQLite format 3\x00" + bytes(1000),
        b"[1, 2]",
        b'{\n  "a": 1\n}',
        b'{"a": 1}',
    ],
    ids=["binary", "database", "list", "pretty", "object"],
)
def test_a_file_that_is_no_journal_is_refused_and_left(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "journal.log"
    path.write_bytes(content)
    with pytest.raises(PipelineError, match=r"journal\.log .* set (it|the file) aside \(mv"):
        open_journal(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("code", [0, 4, 99, "x", None])
def test_changes_that_optuna_does_not_know_are_refused(tmp_path: Path, code: object) -> None:
    path = tmp_path / "journal.log"
    path.write_text(json.dumps({"op_code": code, "worker_id": "w"}) + "\n")
    with pytest.raises(PipelineError, match=r"holds what is none of Optuna's changes .*set it as"):
        open_journal(path)


def test_the_remedy_keeps_the_trials_before_the_damage(home: Path, log: Path) -> None:
    run(home, log, 3)
    path = journal_path(home)
    content = lines(path)
    begun = next(i for i, line in enumerate(content) if b'"trial_id":2' in line)
    content[begun] = b"garbage\n"
    path.write_bytes(b"".join(content))
    with pytest.raises(PipelineError) as caught:
        run(home, log, 3)
    move = re.search(r"\((mv .*?),", str(caught.value))
    keep = re.search(r"`(head .*?)`", str(caught.value))
    assert move is not None
    assert keep is not None
    for command in (move.group(1), keep.group(1)):
        subprocess.run(command, shell=True, cwd=path.parent, check=True)
    first = [t.params for t in study(home, log).trials()[:2]]
    keys = [t.user_attrs["key"] for t in study(home, log).trials()[:2]]
    assert run(home, log, 3).exit_code == 0
    assert [t.params for t in study(home, log).trials()[:2]] == first
    assert study(home, log).ended == 3
    assert [counted(log, f"finished-{key}") for key in keys] == [1, 1]  # not made again


@pytest.mark.parametrize("what", ["another loss", "parameters that do not belong to its fit"])
def test_a_number_that_was_not_written_is_named(home: Path, log: Path, what: str) -> None:
    run(home, log, 3)
    path = journal_path(home)
    best = study(home, log).best()
    assert best is not None
    content = path.read_text()
    if what == "another loss":
        altered = content.replace(f'"values":[{best.value}]', '"values":[0.0]')
    else:
        altered = content.replace(
            f'"param_value_internal":{best.params["x"]}', '"param_value_internal":0.5'
        )
    assert altered != content
    path.write_text(altered)
    with pytest.raises(PipelineError, match=what):
        run(home, log, 3)
    assert path.read_text().startswith(altered)
