"""What the console tells of sweeps, read from a store; names that a browser sends are looked up."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import read_sweep, sweep_files
from flows.status.grid import Part, cell_nodes, grid
from flows.status.shown import headline
from flows.status.sweep_state import SweepState, read_state

__all__ = ["Sweeps", "View"]

_CURVES: Final = "curves.npz"
_SHOWN: Final = ("over_proximity/return", "evaluation/return")
"""Curves of an evaluation, the first one that is there is shown."""
_DOCUMENTS: Final = {"report.html": "report", "ranking.md": "ranking"}


@dataclass(frozen=True)
class View:
    """A sweep at one moment.

    Attributes:
        state: Of it.
        said: What its driver is doing.
        parts: By algorithm and dataset.
    """

    state: SweepState
    said: str
    parts: Mapping[tuple[str, str], Part]


class Sweeps:
    """The sweeps of a store.

    Args:
        root: Its folder; it need not exist.
    """

    def __init__(self, root: Path) -> None:
        self._store = ArtifactStore(root, create=False)

    def names(self) -> list[str]:
        """All of them, the newest first."""
        files = sorted(sweep_files(self._store.root), key=lambda p: p.stat().st_mtime, reverse=True)
        return [path.stem for path in files]

    def view(self, name: str) -> View | None:
        """The state of a sweep; None if there is no such.

        Raises:
            ValueError: Its record is damaged.
        """
        paths = {path.stem: path for path in sweep_files(self._store.root)}
        if name not in paths:
            return None
        state = read_state(self._store, read_sweep(paths[name]))
        return View(state, headline(state, time.time()), grid(state))

    def nodes(self, view: View, algorithm: str, dataset: str) -> list[dict[str, Any]]:
        """The runs of a cell: their names, keys, and what has become of them."""
        state = view.state
        found = []
        for nodes in cell_nodes(state).get((algorithm, dataset), {}).values():
            inputs = [source for node in nodes for source in node.inputs.values()]
            for node in dict.fromkeys([*inputs, *nodes]):
                found.append({"name": node.name, "key": node.key, "state": self._said(node, state)})
        return list({entry["key"]: entry for entry in found}.values())

    def curves(self, view: View, algorithm: str, dataset: str) -> dict[str, list[list[float]]]:
        """Returns of a cell's seeds in the real system: over lambda in percent, or over updates.

        Returns:
            By name of the curve, a pair of numbers for each point.
        """
        found: dict[str, list[list[float]]] = {}
        for seed, nodes in cell_nodes(view.state).get((algorithm, dataset), {}).items():
            for node in nodes:
                if node.component == "evaluation" and node.key in view.state.done:
                    curve = _curve(self._store.path(node.key) / _CURVES)
                    if curve is not None:
                        found[f"seed {seed}"] = curve
        return found

    def documents(self, name: str) -> dict[str, Path]:
        """The reports of a sweep that are there, and rankings of the store, by title."""
        reports = self._store.root / "reports"
        found = {}
        for folder in sorted(reports.glob("*")):
            for file, title in _DOCUMENTS.items():
                own = folder.name == name or folder.name.startswith("ranking-")
                if own and (folder / file).is_file():
                    found[f"{title} {folder.name}"] = folder / file
        return found

    def document(self, name: str) -> Path | None:
        """A document by the title that `documents` gave it for any sweep."""
        everything: dict[str, Path] = {}
        for sweep in self.names():
            everything |= self.documents(sweep)
        return everything.get(name)

    def run_address(self, key: str) -> str | None:
        """Where `flows.ui` shows a node's run of MLflow; None if it has none.

        MLflow is imported, which takes seconds.
        """
        from flows.pipeline.tracking.mlflow_address import StoreAddress
        from flows.pipeline.tracking.mlflow_setup import EXPERIMENT, import_mlflow
        from flows.pipeline.tracking.mlflow_ui import DEFAULT_PORT

        address = StoreAddress(self._store.root)
        if address.own and not address.database.is_file():
            return None
        try:
            client = import_mlflow().MlflowClient(tracking_uri=address.tracking)
            experiment = client.get_experiment_by_name(EXPERIMENT)
            runs = client.search_runs([experiment.experiment_id], f"tags.key = '{key}'")
        except Exception:  # whatever MLflow cannot do, there is no link
            return None
        if not runs:
            return None
        place = f"/#/experiments/{experiment.experiment_id}/runs/{runs[0].info.run_id}"
        return f"http://127.0.0.1:{DEFAULT_PORT}{place}"

    def about(self, key: str) -> dict[str, Any]:
        """What a finished node says of itself: its dataset's card, or its settings."""
        record = self._store.record(key)
        if record["component"] == "data_generation":
            return dict(self._store.read_json(key, "dataset/card.json"))
        return {"component": record["component"], "seconds": record["seconds"]} | record["config"]

    def _said(self, node: Node, state: SweepState) -> str:
        if node.key in state.done:
            return "finished"
        if node.key in state.failed:
            return f"failed: {state.failed[node.key]}"
        if node.key in state.skipped:
            return "needs a failed one"
        if node.key in state.fractions:
            return f"running, {state.fractions[node.key]:.0%}"
        return "missing"


def _curve(path: Path) -> list[list[float]] | None:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name in _SHOWN:
                if f"{name}/value" in arrays:
                    steps, values = arrays[f"{name}/step"], arrays[f"{name}/value"]
                    return np.stack([steps, values], axis=1)[np.isfinite(values)].tolist()
    except (OSError, ValueError, KeyError):
        return None
    return None
