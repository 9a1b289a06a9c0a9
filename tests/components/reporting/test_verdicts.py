"""Verdicts in plain words, and agreement with the thesis."""

import math
from dataclasses import replace

import pytest

from components.reporting.agreement import agreement_table, correlation_rows
from components.reporting.documents import latex_document, markdown_document
from components.reporting.evidence import Evidence, Log
from components.reporting.overview import Column, Overview
from components.reporting.policies import policy_table
from components.reporting.thesis_numbers import Thesis
from components.reporting.verdicts import Verdict, verdicts
from tests.components.reporting.evidence import CELLS, SYSTEM, evidence


def only(found: Evidence, dataset: str = "bad-0.4") -> Verdict:
    return next(verdict for verdict in verdicts(found) if verdict.dataset == dataset)


def with_best(found: Evidence, value: float, interval: tuple[float, float]) -> Evidence:
    """The evidence with TD3+BC as the only algorithm on bad-0.4."""
    column = Column("td3_bc")
    key = ("bad-0.4", column)
    best = replace(found.table.cells[key], value=value, interval=interval, difference=value + 214.0)
    table = Overview([column], found.table.logged, {key: best})
    return replace(found, table=table)


def test_a_gain_is_told_with_its_size_its_peers_and_how_far_lambda_may_go() -> None:
    verdict = only(evidence())
    assert (verdict.judgement, verdict.headline) == ("gain", "Learning from this log pays")
    text = " ".join(verdict.sentences)
    assert "The best is lion at λ 1.00: nine in ten of its policies reach -70.8 or more" in text
    assert "a gain of 143.2 (67%)" in text
    assert "2 of 4 algorithms are above the log." in text
    assert "Beware of bc: -220.8, 6.8 below the log." in text
    assert "lion is above the log for λ from 0.50 to 1.00." in text
    other = only(evidence(), "mediocre-0.2").sentences
    assert other[-1] == "lion is above the log at λ 0.50 only."


@pytest.mark.parametrize(
    ("value", "interval", "judgement", "headline"),
    [
        (-150.0, (-160.0, -140.0), "gain", "Learning from this log pays"),
        (-150.0, (-220.0, -140.0), "unsure", "A gain that may be luck"),
        (-213.0, (-213.5, -212.0), "unsure", "Hardly any gain"),
        (-150.0, (math.nan, math.nan), "unsure", "A gain seen once"),
        (-215.0, (-218.0, -212.0), "none", "As good as the log at most"),
        (-230.0, (-240.0, -220.0), "none", "Leave it as it is"),
    ],
)
def test_intervals_decide(
    value: float, interval: tuple[float, float], judgement: str, headline: str
) -> None:
    verdict = only(with_best(evidence(), value, interval))
    assert (verdict.judgement, verdict.headline) == (judgement, headline)


def test_what_cannot_be_judged() -> None:
    found = evidence()
    unknown = replace(found.table, logged={"bad-0.4": None})
    values = {k: replace(v, difference=None) for k, v in unknown.cells.items()}
    counted = only(replace(found, table=replace(unknown, cells=values)))
    assert (counted.judgement, counted.headline) == ("unknown", "Best: lion at λ 1.00")
    assert "counted otherwise than the log's" in counted.sentences[0]
    assert only(replace(found, cells={})).headline == "Not finished yet"
    diverged = {k: replace(v, value=math.nan) for k, v in found.table.cells.items()}
    lost = only(replace(found, table=replace(found.table, cells=diverged)))
    assert lost.sentences == ["No policy has a finite return."]


def test_agreement_leaves_out_other_discounts_and_says_what_is_apart() -> None:
    table = agreement_table(evidence())
    [row] = table.to_dict("records")
    assert (row["algorithm"], row["here"], row["thesis"]) == ("td3_bc", -214.3, -230.0)
    assert row["apart"], "15.7 is more than 1.7 and 2 together"
    near = agreement_table(evidence(thesis={("bad-0.4", "td3_bc"): Thesis(-217.0, 2.0)}))
    assert not near["apart"].any()
    assert agreement_table(evidence(thesis={})).empty


def test_a_single_seed_is_not_called_apart_nor_nine_in_ten() -> None:
    once = with_best(evidence(), -150.0, (math.nan, math.nan))
    table = agreement_table(once)
    assert not table["apart"].any()
    assert [row["apart"] for row in correlation_rows(table)] == ["unknown"]
    assert "those of its one seed reach -150.0 or more" in only(once).sentences[0]


def test_nothing_comparable_has_no_correlations() -> None:
    assert correlation_rows(agreement_table(evidence(thesis={}))) == []


def test_correlations_are_by_domain_and_over_all() -> None:
    found = evidence()
    logs = found.logs | {"mediocre-0.2": Log("mediocre-0.2", "robot", -77.0, None, "")}
    thesis = {
        (cell.dataset, cell.algorithm): Thesis(place, 0.1)
        for place, cell in enumerate(CELLS)
        if not cell.adapts
    }
    rows = correlation_rows(agreement_table(replace(found, logs=logs, thesis=thesis)))
    assert [(row["domain"], row["cells"]) for row in rows] == [
        ("the Industrial Benchmark (table 5.4)", 3),
        ("the robots (table 5.3)", 2),
        ("all", 5),
    ]
    # here -220.8, -151.8, -214.3 against 0, 1, 2: ranks 1, 3, 2 against 1, 2, 3
    assert rows[0]["spearman"] == pytest.approx(0.5)
    assert SYSTEM not in {row["domain"] for row in rows}


def test_documents_say_what_the_page_says() -> None:
    text = markdown_document(evidence())
    assert "| dataset | logged | bc | ddpg | td3_bc | lion λ=0 |" in text
    assert "**bad-0.4: Learning from this log pays.**" in text
    assert "- td3_bc on mediocre-0.2: 1 of 2 seeds evaluated" in text
    assert "    python -m flows.full_benchmark sweep=toy\n" in text
    assert "- Something <b>odd</b> happened." in text
    latex = latex_document(evidence())
    assert latex.startswith("% python -m flows.full_benchmark sweep=toy\n")
    assert latex.count(r"\toprule") == 1


def test_policies_are_rows_with_their_seed_snapshot_and_proximity() -> None:
    table = policy_table(evidence())
    assert len(table) == 2 * 4 * (5 + 2 * 3)
    lion = table[(table["algorithm"] == "lion") & (table["dataset"] == "bad-0.4")]
    [row] = lion[
        (lion["seed"] == 1) & (lion["updates"] == 1000) & (lion["proximity"] == 0.5)
    ].to_dict("records")
    assert (row["return"], row["pooled"]) == (-119.0, True)
    assert not lion[lion["updates"] < 1000]["pooled"].any()
    assert table[table["algorithm"] == "bc"]["proximity"].isna().all()
    nothing = policy_table(evidence(cells={}))
    assert list(nothing) == list(table), "nothing finished, the same columns"
