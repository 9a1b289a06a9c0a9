"""The overview: a row per dataset, a column per algorithm, and what a terminal shows of it."""

import math
from typing import Any

import pytest

from components.reporting.overview import Column, Overview, overview, shown
from components.reporting.overview_text import latex_overview, markdown_overview, text_overview
from components.reporting.tables import result_table
from components.reporting.thesis_numbers import Thesis
from tests.components.reporting.summaries import LION, TD3_BC, point

PAIR = ("mediocre-0.2", "td3_bc")
BC = TD3_BC | {"algorithm": "bc", "points": [point(None, -100.0)]}
OTHER = TD3_BC | {"dataset": "bad-0.4", "points": [point(None) | {"tenth_percentile": math.nan}]}
LOGGED = {"mediocre-0.2": -80.0, "bad-0.4": None}


def made(*summaries: dict[str, Any]) -> Overview:
    table = result_table(summaries or (TD3_BC, LION, BC, OTHER))
    return overview(table, LOGGED, {PAIR: Thesis(-77.7, 0.1, "²")}, {"¹": "unused", "²": "less."})


def test_lion_has_three_columns_and_every_cell_its_difference() -> None:
    table = made()
    headings = [column.heading for column in table.columns]
    assert headings == ["td3_bc", "lion λ=0", "lion best λ", "lion λ=1", "bc"]
    td3, zero, best, one, bc = table.row("mediocre-0.2")
    assert [c and c.value for c in (zero, best, one)] == pytest.approx(
        [-95.12, -75.12, -85.12], abs=0.01
    )
    assert best is not None
    assert (best.proximity, best.best) == (0.5, True)
    assert [bool(c and c.best) for c in (td3, zero, one, bc)] == [False] * 4
    assert best.difference == pytest.approx(4.88, abs=0.01)
    assert [c is None for c in table.row("bad-0.4")] == [False, True, True, True, True]
    assert table.cells["bad-0.4", Column("td3_bc")].difference is None


def test_only_footnotes_in_use_are_shown() -> None:
    notes = made().notes()
    assert notes[-1] == "² less."
    assert not [note for note in notes if "unused" in note]
    assert any("best λ" in note for note in notes)
    assert not any("best λ" in note for note in made(TD3_BC).notes())


def test_a_note_says_why_nothing_stands_under_logged() -> None:
    def said(table: Overview) -> bool:
        return any(note.startswith("Nothing under logged") for note in table.notes())

    assert said(made())  # bad-0.4's returns are counted otherwise
    assert not said(made(TD3_BC, LION))


def test_the_text_is_aligned_and_names_what_it_shows() -> None:
    assert text_overview(made(), 200) == (
        "dataset       logged      td3_bc    lion     lion    lion       bc\n"
        "                                     λ=0   best λ     λ=1\n"
        "-------------------------------------------------------------------\n"
        "mediocre-0.2   -80.0       -82.1   -95.1    -75.1*  -85.1   -105.1\n"
        "  to logged                 -2.1   -15.1     +4.9    -5.1    -25.1\n"
        "  at λ                                       0.50\n"
        "  thesis                   -77.7²\n"
        "bad-0.4               not finite\n"
    )


def test_a_narrow_window_gets_blocks_with_the_datasets_in_each() -> None:
    text = text_overview(made(), 50)
    blocks = text.split("\n\n")
    assert max(map(len, text.splitlines())) <= 50
    assert [block.split()[:2] for block in blocks] == [["dataset", "logged"]] * len(blocks)
    assert sum(block.count("-105.1") for block in blocks) == 1
    # A column wider than the window stands alone.
    assert len(text_overview(made(), 10).split("\n\n")) == len(made().columns)


def test_markdown_marks_the_best_and_puts_the_thesis_below() -> None:
    assert markdown_overview(made(TD3_BC, LION)).splitlines()[2:] == [
        "| mediocre-0.2 | -80.0 | -82.1 (-2.1) | -95.1 (-15.1) | **-75.1** at 0.50 (+4.9) | "
        "-85.1 (-5.1) |",
        "| thesis |  | -77.7² |  |  |  |",
    ]


def test_latex_has_standard_errors_and_no_bare_underscores() -> None:
    text = latex_overview(made())
    assert r"lion best $\lambda$" in text
    assert r"td3\_bc" in text
    assert r"\textbf{-75.1} (0.2)" in text
    assert r"\quad thesis &  & -77.7 (0.1)" in text
    assert "not finite" in text


def test_numbers_are_shown_without_a_negative_zero() -> None:
    assert [shown(-0.04), shown(-0.04, sign=True), shown(-0.06), shown(0.04, sign=True)] == [
        "0.0", "+0.0", "-0.1", "+0.0",
    ]  # fmt: skip
    assert shown(math.inf) == "not finite"
