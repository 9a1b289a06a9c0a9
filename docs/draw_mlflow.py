"""The screenshots of docs/mlflow.md: ``python docs/draw_mlflow.py STORE DATASET ALGORITHM``.

Opens the MLflow UI of a store in Debian's Chromium and takes every picture at the address that
``python -m flows.ui`` prints. The dataset and the algorithm are those whose pictures are taken.
"""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_setup import LEADERBOARD
from flows.pipeline.tracking.mlflow_ui import UiServer, view_addresses

IMAGES = Path(__file__).parent / "images"
PORT = 5099
WIDTH, HEIGHT = 1280, 800
SECONDS = 8  # until charts are drawn
COLOURS = 256  # of a picture: pages of plain areas, kept small


def main() -> None:
    """Take all pictures."""
    store, dataset, algorithm = sys.argv[1:]
    ledger, board = MlflowExperiment(store), MlflowExperiment(store, name=LEADERBOARD)
    views = view_addresses(PORT, board.entity()) | view_addresses(PORT, ledger.entity())
    cell = f"params.dataset = '{dataset}' and params.algorithm = '{algorithm}'"
    runs = [run.info.run_id for run in board.search(cell)]
    [sweep, *_] = [
        run for run in ledger.search("tags.role = 'sweep'") if run.data.tags.get("kind") is None
    ]
    root = f"http://127.0.0.1:{PORT}/#"
    study = next(name for name in views if name.startswith("Trials of"))
    end = "?workflowType=machine_learning"
    pages = {
        "algorithm": views[f"{algorithm} over the datasets"],
        "dataset": views[f"All algorithms on {dataset}"],
        "seeds": views[f"All algorithms on {dataset}"].replace("&compareRunsMode=CHART", ""),
        "proximity": views["Results over the proximity (step: 100 λ)"],
        "trials": views[study],
        "row": f"{root}/experiments/{board.id}/runs/{runs[0]}{end}",
        "models": f"{root}/experiments/{board.id}/models{end}",
        "figure": f"{root}/experiments/{ledger.id}/runs/{sweep.info.run_id}"
        f"/artifacts/report/{dataset}.png{end}",
    }
    IMAGES.mkdir(exist_ok=True)
    with UiServer(StoreAddress(store), PORT, ledger.entity()), _window() as page:
        page.goto(f"http://127.0.0.1:{PORT}")  # the first page of a browser greets it
        page.wait_for_timeout(1000 * SECONDS)
        for name, address in pages.items():
            page.goto("about:blank")
            page.goto(address)
            page.wait_for_timeout(1000 * SECONDS)  # it asks for news for ever, so it is never idle
            for place in page.get_by_text("Path: file:").all():  # of this computer
                place.evaluate("element => element.style.visibility = 'hidden'")
            _save(page, IMAGES / f"mlflow-{name}.png")


@contextmanager
def _window() -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        # Without the panel of MLflow's assistant.
        page.add_init_script("localStorage.setItem('mlflow.assistant.panelOpen_v1', 'false')")
        yield page
        browser.close()


def _save(page: Page, path: Path) -> None:
    page.screenshot(path=path)
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(COLOURS).save(path, optimize=True)


if __name__ == "__main__":
    main()
