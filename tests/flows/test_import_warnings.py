"""What an import warns of, on the screen and in the report, and what it leaves alone."""

import re
from pathlib import Path

import numpy as np
import pytest

from flows.import_log import import_log, load_import_settings
from tests.flows.furnace import as_csv, furnace, imported, put, write_schema


def test_what_looks_wrong_is_a_warning_in_the_report_and_on_the_screen(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = furnace(20, 50)
    half = 500
    changed = [f"{float(v) * 1.8 + 32:.3f}" for v in cells["temperature"][half:]]
    cells["temperature"] = cells["temperature"][:half] + changed
    cells["profit"] = [f"{x:.4f}" for x in np.random.default_rng(3).normal(size=1000)]
    cells["air"] = [str(10 * (row % 3)) for row in range(1000)]  # whole numbers, three of them
    cells["gas"] = [f"{float(v) / 100:.5f}" for v in cells["gas"]]  # 0 ... 1, not per cent
    imported(cells, history=60)
    said = capsys.readouterr().out
    for sentence in (
        r"Warning: log\.csv, row \d+: about here feature 'temperature' seems to change its unit",
        r"Warning: No feature explains the reward: a fit .* explains \d% of it",
        r"Warning: Action 'air' takes 3 values only",
        r"Warning: Action 'gas' uses 0\.8% of the range between its bounds",
        r"Warning: 20 of 20 episodes have fewer steps than the history of 60",
    ):
        assert re.search(sentence, said), sentence
    report = Path("logs/furnace/report.md").read_text(encoding="utf-8")
    assert all(line[9:] in report for line in said.splitlines() if line.startswith("Warning: "))
    row = int(re.search(r"row (\d+): about here feature 'temperature'", said)[1])
    assert abs(row - half) <= 25  # a part of this log has so many rows


def test_sensors_that_fail_are_warned_of_and_the_log_is_kept(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = furnace(20, 50)
    cells["pressure"] = [f"{x:.3f}" for x in np.random.default_rng(1).normal(1.1, 0.01, 1000)]
    cells["fahrenheit"] = [f"{float(v) * 1.8 + 32:.2f}" for v in cells["temperature"]]
    cells["pressure"][200:400] = ["1.103"] * 200
    for row in (120, 340, 600):
        put("oxygen", row, "-9999")(cells)
    imported(cells, features=["temperature", "oxygen", "pressure", "fahrenheit"])
    said = capsys.readouterr().out
    for sentence in (
        r"log\.csv, row 202: feature 'pressure'.* stands still at 1\.103 for 200 rows from here",
        r"log\.csv, row 120: feature 'oxygen' is -9999 in 3 rows, first here, .*na_values: \[-9999",
        r"Feature 'fahrenheit' is a copy of feature 'temperature' .* 1\.8 \* temperature \+ 32;",
    ):
        assert re.search(f"Warning: {sentence}", said), said


@pytest.mark.parametrize("stands", ["after", "same"])
def test_a_reward_in_another_row_than_the_schema_says(
    project: Path, capsys: pytest.CaptureFixture[str], stands: str
) -> None:
    cells = furnace(20, 90)
    gas = np.array(cells["gas"], float)
    if stands == "after":
        gas = np.roll(gas, 1)  # the first row of an episode is not used
    cells["profit"] = [
        f"{-abs(float(t) - 800) - g:.3f}" for t, g in zip(cells["temperature"], gas, strict=True)
    ]
    other = {"after": "same", "same": "after"}[stands]
    imported(cells, outcome_row=stands)
    assert "outcome_row" not in capsys.readouterr().out
    imported(cells, "replace=true", outcome_row=other)
    assert re.search(
        rf"Warning: The action of .* should outcome_row be {stands}\?", capsys.readouterr().out
    )


def test_what_a_sweep_will_leave_out_is_said(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(furnace(3, 80))
    said = capsys.readouterr().out
    assert "Warning: The log has 3 episodes, but it takes 4 to divide it" in said
    assert (
        "Warning: The longest episode has 79 steps, but models that read histories need 80" in said
    )
    imported(furnace(4, 81), "replace=true")
    assert "Warning" not in capsys.readouterr().out


def test_a_file_in_another_unit_is_named(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cells = furnace(20, 50)
    half = 500
    Path("a.csv").write_text(as_csv({n: v[:half] for n, v in cells.items()}), encoding="utf-8")
    later = {n: v[half:] for n, v in cells.items()}
    later["gas"] = [f"{float(v) / 60:.4f}" for v in later["gas"]]  # per second
    Path("b.csv").write_text(as_csv(later), encoding="utf-8")
    write_schema(project)
    import_log(load_import_settings(["a.csv", "b.csv", "name=furnace"]))
    said = re.search(
        r"Warning: b\.csv, row 2, where this file begins: action 'gas' seems to be in another unit "
        r"than in a\.csv: its median goes from (\S+) to (\S+) and stays",
        capsys.readouterr().out,
    )
    assert said
    assert 40 < float(said[1]) < 60  # in the log's units
    assert 40 < 60 * float(said[2]) < 60


def test_a_log_as_it_should_be_has_no_warnings(project: Path) -> None:
    imported(furnace(20, 90))
    assert "## What looks wrong\n\nNothing." in Path("logs/furnace/report.md").read_text("utf-8")
