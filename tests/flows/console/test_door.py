"""The console's door: what it refuses, and replays."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from flows.configuration.checking import SettingsError
from flows.console.__main__ import HELP, load_console_settings, run
from flows.console.bench import Bench
from flows.console.catalogue import Catalogue
from flows.console.server import bound
from flows.door import run_door
from tests.conftest import ROOT


def door(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["console", *words])
    with pytest.raises(SystemExit) as ended:
        run_door("console", HELP, load_console_settings, run)
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["prot=1"], "Unknown key 'prot'"),
        (["port=0"], "port='0': Input should be greater than or equal to 1."),
        (["console.port=70000"], "port='70000': Input should be less than or equal to 65535."),
        (["port=1", "console.port=2"], "port is given twice; give it once."),
        (["margin=0"], "margin='0': Input should be greater than 0."),
        (["slope=nan"], "slope='nan': Input should be"),
        (["policies=conf"], "policies=conf holds no packed policy; give a folder that python -m"),
        (["policies=/nowhere/at/all"], "holds no packed policy"),
        (["8085"], "'8085' is not an override; write key=value"),
    ],
)
def test_refusals(
    words: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert door(monkeypatch, *words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_a_port_that_is_taken_ends_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert door(monkeypatch, f"console.port={port}") == 2
        said = capsys.readouterr().err
        assert said == (
            f"console: port={port} cannot be used (Address already in use); leave it out to take a "
            "free one.\n"
        )
        with pytest.raises(SettingsError):
            bound(port)


def test_without_a_port_a_free_one_is_taken_on_this_computer_alone() -> None:
    first, second = bound(None), bound(None)
    try:
        assert first.getsockname()[0] == second.getsockname()[0] == "127.0.0.1"
        assert first.getsockname()[1] != second.getsockname()[1]
    finally:
        first.close()
        second.close()


def test_a_saved_session_is_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(Catalogue(tmp_path).open("world"), "world")
    for proximity in (0.0, 0.9, 0.9, 0.2):
        bench.turn(proximity)
        bench.step()
    saved = bench.save(tmp_path / "sessions")
    assert bench.save(tmp_path / "sessions") != saved  # another name in the same second
    assert door(monkeypatch, f"replay={saved}", f"store={tmp_path}") == 0
    assert "4 steps replayed, to the same bytes." in capsys.readouterr().out
    card = saved / "session.json"
    card.write_text(card.read_text().replace('"world"', '"../../etc/passwd"'))
    assert door(monkeypatch, f"replay={saved}", f"store={tmp_path}") == 2
    assert "is of a policy that store=" in capsys.readouterr().err
    assert door(monkeypatch, f"replay={tmp_path / 'nothing'}") == 1
    assert "There is no recording in" in capsys.readouterr().err


def test_a_session_of_a_packed_policy_is_replayed_from_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Catalogue(tmp_path).open("world").save(tmp_path / "packed" / "furnace")
    offered = Catalogue(tmp_path, tmp_path / "packed").open("packed/furnace")
    bench = Bench(offered, "packed/furnace")
    bench.step()
    saved = bench.save(tmp_path / "sessions")
    words = (f"replay={saved}", f"store={tmp_path}")
    assert door(monkeypatch, *words, f"policies={tmp_path / 'packed'}") == 0
    assert "1 steps replayed" in capsys.readouterr().out
    assert door(monkeypatch, *words) == 2
    assert "with policies= the folder" in capsys.readouterr().err


_FIRST_PAGE = """
import sys, threading, urllib.request
from pathlib import Path
from flows.console.__main__ import load_console_settings
from flows.console.server import bound, serve
import os

def look(address):
    def ask():
        said = urllib.request.urlopen(address).read().decode()
        print("λ" in said or "familiar" in said, sorted({"mlflow", "ray"} & set(sys.modules)))
        sys.stdout.flush()
        os._exit(0)
    threading.Thread(target=ask).start()

settings = load_console_settings(sys.argv[1:])
from flows.console.catalogue import Catalogue
Catalogue(settings.store).open("turbine")
serve(bound(None), settings.store, look)
"""


def test_the_first_page_needs_neither_mlflow_nor_ray(tmp_path: Path) -> None:
    """Both take seconds to import, which is what waiting for the first turn of the dial is."""
    words = [sys.executable, "-W", "ignore", "-c", _FIRST_PAGE, f"store={tmp_path}"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "True []", done.stderr


@pytest.mark.parametrize("sent", [None, "0.5", [0.5], {}, float("nan"), 2.0, -1, "x" * 10_000])
def test_what_is_no_proximity_does_not_turn_anything(sent: object, tmp_path: Path) -> None:
    bench = Bench(Catalogue(tmp_path).open("world"), "world")
    bench.turn(0.25)
    bench.turn(sent)
    assert bench.session.proximity == 0.25


def test_a_full_recording_ends_the_run_and_a_reset_begins_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flows.console.bench.MOST", 3)
    bench = Bench(Catalogue(tmp_path).open("world"), "world")
    drawn = [bench.step() for _ in range(3)]
    assert bench.full
    assert not bench.running
    bench.restart()
    assert bench.running
    assert [bench.step() for _ in range(3)] == drawn  # from the first start


def test_a_reset_keeps_what_the_operator_has_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(Catalogue(tmp_path).open("turbine"), "turbine")
    bench.step()
    bench.turn(0.5)
    bench.session.driver = "behaviour"
    bench.session.plant.demand(55.0)
    bench.restart()
    for _ in range(2):
        bench.step()
    assert bench.last is not None
    assert (bench.last.episode, bench.last.step, bench.last.setpoint) == (0, 1, 55.0)
    assert bench.last.frames[0, 0] == 55.0  # the turbine sees it
    assert (bench.last.driver, bench.last.proximity) == ("behaviour", 0.5)
    saved = bench.save(tmp_path / "sessions")
    assert door(monkeypatch, f"replay={saved}", f"store={tmp_path}") == 0
