"""What people find in MLflow's own pages, in a real browser: sweep, chart, figure, model, data."""

import os
import shutil
import socket
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

pytest.importorskip("playwright", reason="the browser is driven by Playwright")
from playwright.sync_api import Page, expect

from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_setup import LEADERBOARD
from flows.pipeline.tracking.mlflow_ui import UiServer, runs_address, view_addresses
from tests.browser import visited
from tests.conftest import SmokeRun

pytestmark = pytest.mark.slow(10)

PATIENCE = 60_000  # milliseconds until a page must show something, on a busy computer
CELL = "mediocre-0.2/lion/seed0"


class Ui(NamedTuple):
    """A served copy of the smoke run's store."""

    port: int
    ledger: MlflowExperiment
    board: MlflowExperiment

    def of(self, experiment: MlflowExperiment, page: str) -> str:
        return runs_address(self.port, experiment.entity()).replace("/runs?", f"/{page}?")


@pytest.fixture(scope="module")
def ui(smoke: SmokeRun, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ui]:
    if shutil.which("chromium") is None:
        pytest.skip("there is no chromium; apt-get install chromium")
    store = tmp_path_factory.mktemp("pages") / "mlruns"
    store.mkdir()
    shutil.copytree(smoke.store / "artifacts", store / "artifacts", copy_function=os.link)
    for file in smoke.store.glob("mlflow.db*"):
        shutil.copy(file, store)
    with pytest.MonkeyPatch.context() as patch, socket.socket() as free:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        ledger, board = MlflowExperiment(store), MlflowExperiment(store, name=LEADERBOARD)
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
        free.close()
        with UiServer(StoreAddress(store), port, ledger.entity()):
            yield Ui(port, ledger, board)


def sees(page: Page, text: str) -> None:
    expect(page.get_by_text(text, exact=True).first).to_be_visible(timeout=PATIENCE)


def run_of(experiment: MlflowExperiment, text: str) -> Any:
    return next(experiment.search(text))


def test_every_evaluation_is_one_row(ui: Ui) -> None:
    evaluations = list(ui.ledger.search("tags.component = 'evaluation'"))
    rows = list(ui.board.search("tags.role = 'row'"))
    assert {row.data.tags["key.evaluation"] for row in rows} == {
        run.data.tags["key"] for run in evaluations
    }
    assert len(rows) == len(evaluations) == 30


def test_a_view_shows_the_algorithms_of_a_dataset_side_by_side(ui: Ui) -> None:
    address = view_addresses(ui.port, ui.board.entity())["All algorithms on mediocre-0.2"]
    with visited(address) as visit:
        sees(visit.page, "Group: td3_bc")
        sees(visit.page, "return/tenth_percentile")
        bars = visit.page.locator(".js-plotly-plot .barlayer .point")
        expect(bars.nth(10)).to_be_attached(timeout=PATIENCE)  # a bar per algorithm and chart


def test_a_view_shows_the_chart_over_the_proximity(ui: Ui) -> None:
    address = view_addresses(ui.port, ui.board.entity())["Results over the proximity (step: 100 λ)"]
    with visited(address) as visit:
        sees(visit.page, CELL)
        lines = visit.page.locator(".js-plotly-plot .scatterlayer .trace")
        expect(lines.first).to_be_attached(timeout=PATIENCE)


def test_the_sweep_is_found_and_its_figure_is_shown(ui: Ui) -> None:
    address = view_addresses(ui.port, ui.ledger.entity())["Sweeps"]
    with visited(address) as visit:
        sees(visit.page, "smoke")
    sweep = run_of(ui.ledger, "tags.role = 'sweep'").info.run_id
    figure = ui.of(ui.ledger, f"runs/{sweep}/artifacts/report/mediocre-0.2.png")
    with visited(figure) as visit:
        sees(visit.page, "results.md")
        picture = visit.page.locator("img[src^='blob:'], img[src*='get-artifact']").first
        expect(picture).to_be_visible(timeout=PATIENCE)
        assert picture.evaluate("image => image.naturalWidth") > 100


def test_the_model_of_a_policy_is_listed(ui: Ui) -> None:
    with visited(ui.of(ui.board, "models")) as visit:
        sees(visit.page, "mediocre-0_2_lion_seed0")
        sees(visit.page, "lion/mediocre-0.2/seed0")  # the run of its training


def test_a_result_leads_back_to_its_data(ui: Ui) -> None:
    row = run_of(ui.board, f"tags.`mlflow.runName` = '{CELL}'").info.run_id
    data = run_of(ui.ledger, "tags.component = 'data_generation'").info.run_id
    with visited(ui.of(ui.board, f"runs/{row}")) as visit:
        link = visit.page.get_by_role("link", name="data/mediocre-0.2", exact=True).first
        link.evaluate("link => link.target = '_self'")  # MLflow may ask for another window
        link.click(timeout=PATIENCE)
        visit.page.wait_for_url(f"**/experiments/{ui.ledger.id}/runs/{data}*", timeout=PATIENCE)
        sees(visit.page, "data/mediocre-0.2")
