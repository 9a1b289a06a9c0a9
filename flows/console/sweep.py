"""The page on which a sweep is watched: its grid, live, and what is behind a cell."""

import json
from typing import Any, Final
from urllib.parse import quote

from nicegui import run, ui
from nicegui.events import ValueChangeEventArguments

from flows.console.layout import card, frame
from flows.console.sweeps import Sweeps, View
from flows.status.grid import Part

__all__ = ["Sweep"]

_EVERY: Final = 3.0  # seconds between two looks
_LONGEST: Final = 4000  # characters of a record that are shown


class Sweep:
    """One window.

    Args:
        sweeps: Of the store.
    """

    def __init__(self, sweeps: Sweeps) -> None:
        self._sweeps = sweeps
        self._name = ""
        self._view: View | None = None
        self._cell: tuple[str, str] | None = None
        self._drawn: Any = None

    async def show(self, asked: str) -> None:
        """Build the page.

        Args:
            asked: Name of the sweep from the address; empty: the newest.
        """
        names = await run.io_bound(self._sweeps.names)
        with frame("sweep"):
            self._choice = ui.select(names, label="sweep", on_change=self._chosen)
            self._choice.classes("choice").mark("sweep")
            self._said = ui.label("").classes("said").mark("said")
            self._links = ui.row().classes("gap-4")
            with card().classes("grid-box"):
                self._table = ui.element("div").mark("grid")
            self._details = card().mark("details")
            self._details.set_visibility(False)
        await ui.context.client.connected()
        first = asked or next(iter(names), "")
        if first in names:
            self._choice.value = first
        else:
            self._said.text = (
                "There is no such sweep; choose one of the list."
                if names
                else "The store holds no sweep yet: python -m flows.full_benchmark makes one."
            )
        ui.timer(_EVERY, self._look)

    async def _chosen(self, event: ValueChangeEventArguments) -> None:
        self._name, self._cell, self._drawn = event.value, None, None
        self._details.set_visibility(False)
        documents = await run.io_bound(self._sweeps.documents, self._name)
        self._links.clear()
        with self._links:
            for title in documents:
                ui.link(title, f"/document?name={quote(title)}", new_tab=True)
            if not documents:
                ui.label(f"No report yet: python -m flows.report sweep={self._name}")
        await self._look()

    async def _look(self) -> None:
        if not self._name:
            return
        try:
            self._view = await run.io_bound(self._sweeps.view, self._name)
        except (ValueError, OSError) as error:
            self._said.text = str(error)
            return
        if self._view is None:
            self._said.text = "This sweep is gone."
            return
        self._said.text = self._view.said
        shown = {pair: part.numbers() for pair, part in self._view.parts.items()}
        if shown != self._drawn:
            self._drawn = shown
            self._draw(self._view.parts)

    def _draw(self, parts: Any) -> None:
        algorithms = list(dict.fromkeys(algorithm for algorithm, _ in parts))
        datasets = list(dict.fromkeys(dataset for _, dataset in parts))
        self._table.clear()
        with self._table, ui.element("table").classes("cells"):
            with ui.element("tr"):
                for title in ("dataset", *algorithms):
                    with ui.element("th"):
                        ui.label(title)
            for dataset in datasets:
                with ui.element("tr"):
                    with ui.element("th"):
                        ui.label(dataset)
                    for algorithm in algorithms:
                        with ui.element("td"):
                            self._draw_cell(parts.get((algorithm, dataset)), algorithm, dataset)
        if not parts:
            with self._table:
                ui.label("This sweep has no grid; flows.status tells more of it.")

    def _draw_cell(self, part: Part | None, algorithm: str, dataset: str) -> None:
        if part is None:
            return
        kind = "failed" if part.failed else "running" if part.running else ""
        kind = "done" if part.done == part.total else kind
        marks = " ▶" * bool(part.running) + " ✗" * bool(part.failed)
        button = ui.element("button").classes(f"cell {kind}")
        button.on("click", lambda: self._open(algorithm, dataset))
        button.props["style"] = f"--part: {part.fraction:.0%}"
        with button:
            ui.label(f"{part.done}/{part.total}{marks}")

    async def _open(self, algorithm: str, dataset: str) -> None:
        view = self._view
        if view is None:
            return
        nodes = await run.io_bound(self._sweeps.nodes, view, algorithm, dataset)
        curves = await run.io_bound(self._sweeps.curves, view, algorithm, dataset)
        self._details.clear()
        self._details.set_visibility(True)
        with self._details:
            ui.label(f"{algorithm} on {dataset}").classes("heading")
            if curves:
                _chart(curves)
            else:
                ui.label("No seed is evaluated yet.")
            for node in nodes:
                self._draw_node(node)

    def _draw_node(self, node: dict[str, Any]) -> None:
        async def about() -> None:
            said = await run.io_bound(self._sweeps.about, node["key"])
            place.clear()
            with place:
                ui.label(json.dumps(said, indent=1)[:_LONGEST]).classes("record")

        async def linked() -> None:
            place.clear()
            with place:
                ui.label("Asking MLflow …")
            address = await run.io_bound(self._sweeps.run_address, node["key"])
            place.clear()
            with place:
                if address is None:
                    ui.label("MLflow has no run of it; the node's folder is nodes/" + node["key"])
                else:
                    ui.link(address, address, new_tab=True)
                    ui.label("opens while python -m flows.ui runs on this store.")

        with ui.element("div").classes("node"):
            with ui.row().classes("items-center gap-2"):
                ui.label(node["name"]).classes("node-name")
                ui.label(node["state"]).classes("node-state")
                if node["state"] == "finished":
                    ui.button("about", on_click=about).props("flat dense size=sm")
                    ui.button("run", on_click=linked).props("flat dense size=sm")
                if node["state"] == "finished" and node["name"].startswith("lion/"):
                    ui.link("turn it", f"/?policy={node['key']}")
            place = ui.element("div")


def _chart(curves: dict[str, list[list[float]]]) -> None:
    over_proximity = all(curve[-1][0] == 100 and len(curve) > 2 for curve in curves.values())
    ui.echart(
        {
            "animation": False,
            "grid": {"left": 60, "right": 20, "top": 30, "bottom": 45},
            "legend": {"top": 0},
            "tooltip": {"trigger": "axis"},
            "xAxis": {
                "type": "value",
                "name": "λ in percent" if over_proximity else "updates",
                "nameLocation": "middle",
                "nameGap": 26,
            },
            "yAxis": {"type": "value", "scale": True, "name": "return"},
            "series": [
                {"type": "line", "name": name, "data": curve, "symbolSize": 5}
                for name, curve in curves.items()
            ],
        }
    ).classes("chart")
