"""The notebooks: kept without outputs, free of logic, and running on a real sweep's store."""

import ast
import shutil
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.conftest import ROOT, SmokeRun

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LOGIC = (ast.FunctionDef, ast.ClassDef, ast.If, ast.While, ast.Try, ast.Lambda)


def code_cells(path: Path) -> list[nbformat.NotebookNode]:
    cells = nbformat.read(path, as_version=4).cells
    return [cell for cell in cells if cell.cell_type == "code"]


def test_there_are_notebooks() -> None:
    assert [path.name for path in NOTEBOOKS] == ["dataset.ipynb", "lion.ipynb", "results.ipynb"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_outputs_are_cleared(path: Path) -> None:
    for cell in code_cells(path):
        assert cell.outputs == []
        assert cell.execution_count is None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_hold_no_logic(path: Path) -> None:
    for cell in code_cells(path):
        lines = [line for line in cell.source.splitlines() if not line.startswith("%")]
        assert not [n for n in ast.walk(ast.parse("\n".join(lines))) if isinstance(n, LOGIC)]


def executed(name: str, folder: Path) -> list[nbformat.NotebookNode]:
    """All outputs of a notebook that runs in a folder."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": folder}}
    ).execute()
    return [out for cell in notebook.cells for out in cell.get("outputs", [])]


@pytest.mark.slow(25)
def test_a_dataset_and_its_ranking(tmp_path: Path) -> None:
    outputs = executed("dataset", tmp_path)
    tables = [out.data["text/html"] for out in outputs if "text/html" in out.get("data", {})]
    card, ranking = tables
    for name in ("mediocre-0.0", "mediocre-0.2", "mediocre-0.6"):
        assert name in card
        assert name in ranking
    assert "Limited by" in ranking
    assert len([out for out in outputs if "image/png" in out.get("data", {})]) == 2
    assert not [out for out in outputs if out.output_type in ("stream", "error")]


@pytest.mark.slow(15)
def test_lion_by_hand(smoke: SmokeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PROXIMITY_STORE", str(smoke.store))
    monkeypatch.setenv("PROXIMITY_RUN", "lion/mediocre-0.2/seed1")
    outputs = executed("lion", tmp_path)
    shown = [out.data for out in outputs if "data" in out]
    assert "lion on mediocre-0.2, seed 1" in shown[0]["text/plain"]
    assert [data for data in shown if "application/vnd.jupyter.widget-view+json" in data]
    assert "discounted return" in shown[-1]["text/plain"]
    assert not [out for out in outputs if out.output_type in ("stream", "error")]


@pytest.mark.slow(20)
def test_results_notebook_shows_table_and_figure(
    smoke: SmokeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A later sweep of another kind lies beside the one that is asked for; its files are no report.
    store = tmp_path / "runs"
    store.mkdir()
    (store / "nodes").symlink_to(smoke.store / "nodes")
    shutil.copytree(smoke.store / "reports", store / "reports")
    (store / "reports" / "later").mkdir()
    (store / "reports" / "later" / "results.csv").write_text("no table\n")
    monkeypatch.setenv("PROXIMITY_STORE", str(store))
    monkeypatch.setenv("PROXIMITY_SWEEP", "smoke")
    outputs = executed("results", tmp_path)
    shown = [out.data for out in outputs if "data" in out]
    texts = [data["text/markdown"] for data in shown if "text/markdown" in data]
    assert texts[0] == "Sweep **smoke**"
    report = smoke.store / "reports" / "smoke" / "results.md"
    assert texts[-1] in report.read_text(encoding="utf-8")
    beside, over_proximity = [data["text/html"] for data in shown if "text/html" in data]
    assert "td3_bc" in beside
    assert "thesis_tenth_percentile" in beside
    assert "-77.7" not in beside, "the thesis's TD3+BC on mediocre-0.2 is over 100 steps, not 20"
    assert "lion" in over_proximity
    assert "NaN" not in beside + over_proximity
    figures = [out for out in outputs if "image/png" in out.get("data", {})]
    assert len(figures) == 1  # the smoke run has one dataset
    assert not [out for out in outputs if out.output_type in ("stream", "error")]
