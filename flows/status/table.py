"""The table so far: results of the pairs that are finished with all their seeds."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from components.reporting.overview import overview
from components.reporting.overview_text import text_overview
from components.reporting.tables import result_table, with_undefined
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.status.sweep_state import SweepState

__all__ = ["results", "table_text"]


def results(state: SweepState, store: ArtifactStore) -> pd.DataFrame:
    """One row per dataset, algorithm and proximity.

    Raises:
        DamagedFileError: A result is damaged.
    """
    return result_table(
        with_undefined(store.read_json(node.key, "summary.json"))
        for node in _finished(state, "aggregation")
    )


def table_text(state: SweepState, store: ArtifactStore, table: pd.DataFrame, width: int) -> str:
    """The table that a sweep prints, without the thesis's values and intervals.

    Args:
        state: Of the sweep.
        store: With its artifacts.
        table: What `results` returned.
        width: Of the window in characters.

    Raises:
        DamagedFileError: A dataset's card is damaged.
    """
    if table.empty:
        return ""
    logged = {
        node.tags["dataset"]: _level(node, state, store)
        for node in _finished(state, "data_generation")
    }
    return text_overview(overview(table, logged, {}, {}), width)


def _finished(state: SweepState, component: str) -> list[Node]:
    nodes = state.plan or ()
    return [node for node in nodes if node.component == component and node.key in state.done]


def _level(data: Node, state: SweepState, store: ArtifactStore) -> float | None:
    """The logged behaviour's return, if it is counted as the policies' are."""
    card: Mapping[str, Any] = store.read_json(data.key, "dataset/card.json")
    counted = card.get("return_steps"), card.get("discount")
    for cell in _finished(state, "aggregation"):
        if cell.tags["dataset"] == data.tags["dataset"]:
            evaluation = next(iter(cell.inputs.values())).key
            protocol = store.record(evaluation)["config"]["evaluation"]
            if (protocol["horizon"], protocol["discount"]) != counted:
                return None
    level = card.get("first_window_return_mean")
    return None if level is None else float(level)
