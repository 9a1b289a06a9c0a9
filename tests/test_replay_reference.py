"""The recordings of the reference replay, and the command says clearly when they do not."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from tests.replay_reference import COLUMNS, TOLERANCE, main, read_recording, replay

FOLDER = Path(__file__).parent / "data" / "industrial_benchmark"
RECORDINGS = [(0, 88.0, 1005), (3, 80.0, 1008), (7, 84.0, 1012)]


@pytest.mark.parametrize(("number", "setpoint", "seed"), RECORDINGS)
def test_recording_replays_in_every_column(number: int, setpoint: float, seed: int) -> None:
    recorded = read_recording(FOLDER / f"markov_states_{number}.csv.gz")
    replayed = replay(len(recorded), setpoint, seed)
    deviations = dict(zip(COLUMNS, np.abs(replayed - recorded).max(axis=0), strict=True))
    # rounding of costs of up to a few hundred over 1,000 steps is about 1e-12
    assert max(deviations.values()) < 1e-9, deviations


def test_recordings_reach_the_branches_that_matter() -> None:
    rows = np.concatenate(
        [read_recording(FOLDER / f"markov_states_{number}.csv.gz") for number, _, _ in RECORDINGS]
    )
    column = {name: rows[:, index] for index, name in enumerate(COLUMNS)}
    hidden = np.maximum(column["hidden_gain"], column["hidden_velocity"])
    assert (hidden == 5.0).sum() > 100
    assert ((hidden >= 1.2) & (hidden < 5.0)).sum() > 10
    assert set(column["direction"]) == set(range(-6, 7))
    assert set(column["response"]) == set(column["domain"]) == {-1.0, 1.0}
    assert (np.abs(column["effective_shift"]) == 1.5).any()


def test_command_accepts_plain_and_compressed_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    compressed = FOLDER / "markov_states_0.csv.gz"
    plain = tmp_path / "recording.csv"
    plain.write_bytes(gzip.decompress(compressed.read_bytes()))
    for path in (compressed, plain):
        assert main([str(path), "--setpoint", "88", "--seed", "1005"]) == 0
        assert float(capsys.readouterr().out.split()[0]) < TOLERANCE


@pytest.mark.parametrize("options", [("88", "1006"), ("87", "1005")])
def test_command_fails_for_another_seed_or_setpoint(
    options: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = FOLDER / "markov_states_0.csv.gz"
    assert main([str(path), "--setpoint", options[0], "--seed", options[1]]) == 1
    assert float(capsys.readouterr().out.split()[0]) > TOLERANCE


@pytest.mark.parametrize(
    ("content", "arguments", "message"),
    [
        (None, ("88", "1"), "there is no recording"),
        ("", ("88", "1"), "at least one row"),
        ("1,2,3\n", ("88", "1"), "29 columns"),
        ("a,b\n", ("88", "1"), "cannot be read as numbers"),
        (",".join(["0"] * 29), ("101", "1"), "setpoint is 101.0"),
        (",".join(["0"] * 29), ("88", "-1"), "seed is -1"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_command_refuses_bad_input_in_one_sentence(
    content: str | None,
    arguments: tuple[str, str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "recording.csv"
    if content is not None:
        path.write_text(content)
    assert main([str(path), "--setpoint", arguments[0], "--seed", arguments[1]]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
