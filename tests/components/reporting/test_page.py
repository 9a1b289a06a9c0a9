"""The page in a real browser: all its parts, its switches, and that it needs no network."""

import json
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser

import pandas as pd
import pytest

from components.reporting.evidence import Log
from components.reporting.page import PARTS, page
from tests.browser import Visit, visited
from tests.components.reporting.evidence import LEVELS, SYSTEM, evidence
from tests.components.reporting.judged import log

FIGURES = ("judged-0", "thesis", "middles", "profiles", "improvement", "ranks", "lambda", "curves")


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page(evidence(judged=[log()])), encoding="utf-8")
    assert path.stat().st_size < 10e6
    return path.as_uri()


@pytest.fixture(scope="module")  # tests/conftest.py keeps this file's tests together
def wide(address: str) -> Iterator[Visit]:
    with visited(address) as visit:
        visit.page.wait_for_selector("body[data-ready]")
        yield visit


def traces(visit: Visit, figure: str) -> list[str]:
    """Names of the curves of a figure."""
    found = visit.page.evaluate(f"document.getElementById('figure-{figure}').data.map(t => t.name)")
    return [name for name in found if name]


@pytest.mark.slow(5)
def test_every_part_is_there_and_every_figure_is_drawn(wide: Visit) -> None:
    for part, _ in PARTS:
        assert wide.page.is_visible(f"section#{part} h2"), part
    for figure in FIGURES:
        box = wide.page.locator(f"#figure-{figure} .main-svg").first.bounding_box()
        assert box is not None, figure
        assert box["width"] > 500, figure
    assert wide.page.locator(".gap").count() == 1
    assert "1 of 2 seeds evaluated" in wide.page.inner_text("td.gap")
    assert "Something <b>odd</b> happened." in wide.page.inner_text("#differences")


@pytest.mark.slow(2)
def test_a_toggle_hides_an_algorithm_everywhere_and_shows_it_again(wide: Visit) -> None:
    column, chip = wide.page.locator("th[data-a='bc']").first, "[data-toggle='bc']"
    assert column.is_visible()
    assert "bc" in traces(wide, "curves")
    wide.page.click(chip)
    assert wide.page.get_attribute(chip, "aria-pressed") == "false"
    assert not column.is_visible()
    assert "bc" not in traces(wide, "curves") + traces(wide, "profiles")
    wide.page.click(chip)
    assert column.is_visible()
    assert "bc" in traces(wide, "curves")


@pytest.mark.slow(2)
def test_lambda_and_dataset_are_chosen(wide: Visit) -> None:
    rows = wide.page.locator("#at-lambda tbody tr")
    assert "-70.8" in rows.first.inner_text()  # at λ 1
    wide.page.fill("#slider", "0.5")
    assert wide.page.inner_text("#chosen") == "0.50"
    assert "-120.8" in rows.first.inner_text()
    title = "document.getElementById('figure-curves').layout.title.text"
    assert wide.page.evaluate(title) == "bad-0.4 · profile quick, 2 seeds"
    wide.page.select_option("[data-dataset='curves']", "mediocre-0.2")
    assert wide.page.evaluate(title) == "mediocre-0.2 · profile quick, 2 seeds"
    assert sorted(set(traces(wide, "curves"))) == ["bc", "ddpg", "lion"]


@pytest.mark.slow(1)
def test_switches_show_intervals_below_the_values(wide: Visit) -> None:
    interval = wide.page.locator("td small.interval").first
    assert not interval.is_visible()
    wide.page.check("[data-line='interval']")
    assert interval.is_visible()
    assert "-221.0 … -219.0" in interval.inner_text()


@pytest.mark.slow(1)
def test_no_level_far_away_squeezes_the_others_and_it_is_named_at_the_edge(wide: Visit) -> None:
    wide.page.select_option("[data-dataset='lambda']", "mediocre-0.2")
    figure = "document.getElementById('figure-lambda').layout"
    names = wide.page.evaluate(f"{figure}.annotations.map(a => [a.text, a.x, a.xanchor])")
    assert ["logged -77.0", 1, "left"] in names
    assert all(place == [1, "left"] for _, *place in names), "to the right of all lines"
    assert wide.page.evaluate(f"{figure}.showlegend") is False


@pytest.mark.slow(1)
def test_nothing_is_asked_of_the_network_and_nothing_could_be(wide: Visit, address: str) -> None:
    assert set(wide.requests) == {address}
    assert wide.complaints == []
    refused = wide.page.evaluate(
        "fetch('http://127.0.0.1:9/').then(() => 'sent', error => 'refused')"
    )
    assert refused == "refused"
    assert set(wide.requests) == {address}, "the page's policy stops requests before they are made"


@pytest.mark.slow(1)
def test_a_phone_shows_it_without_scrolling_sideways(wide: Visit) -> None:
    wide.complaints.clear()
    wide.page.set_viewport_size({"width": 400, "height": 800})
    wide.page.reload()
    wide.page.wait_for_selector("body[data-ready]")
    assert wide.page.evaluate("document.documentElement.scrollWidth") <= 400
    for figure in FIGURES:
        box = wide.page.locator(f"#figure-{figure} .main-svg").first.bounding_box()
        assert box is not None, figure
        assert box["width"] <= 400, figure
    assert wide.complaints == []


class Elements(HTMLParser):
    """Counts the elements of a page and keeps the text of its data."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []
        self.data = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(f"{tag}#{dict(attrs).get('id', '')}")

    def handle_data(self, data: str) -> None:
        if self.names and self.names[-1] == "script#data":
            self.data += data


def test_text_of_users_stays_text() -> None:
    evil = "</script><img src=x onerror=alert(1)>"
    table = pd.DataFrame([{"part": evil, "setting": "a", "datasets": 1}])
    logs = {n: Log(n, SYSTEM, level, level, evil) for n, level in LEVELS.items()}
    found = evidence(differences=table, logs=logs, budget=evil, sweeps={"toy": evil}, notes=[evil])
    elements = Elements()
    elements.feed(page(found))
    assert not [name for name in elements.names if name.startswith("img")]
    assert json.loads(elements.data)["budget"] == evil


def test_what_is_missing_is_said() -> None:
    text = page(evidence(across=None, thesis={}))
    assert "Nothing to compare yet" in text
    assert "No cell of this sweep has a value in the thesis" in text
    assert "python -m flows.rank_datasets makes this table" in text
    ranked = page(evidence(ranking=pd.DataFrame([{"dataset": "bad-0.4", "eri": 0.75}])))
    assert "<td>0.75</td>" in ranked
    assert "judging.policies=all does it" in text
    assert "Logs without a" not in text
    rows = pd.DataFrame([{"judge": "critic", "regret": 1.5}])
    assert page(evidence(selection=rows, judges=rows)).count("<td>1.50</td>") == 2
    fixed = evidence()
    cells = {pair: cell for pair, cell in fixed.cells.items() if not cell.adapts}
    assert "No policy that was tried takes a proximity" in page(replace(fixed, cells=cells))
