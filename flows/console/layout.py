"""What all pages of the console share: the bar with the ways between them, cards, numbers."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nicegui import ui

__all__ = ["card", "frame", "number"]

_STYLE = (Path(__file__).parent / "web" / "console.css").read_text(encoding="utf-8")
_PAGES = {"operate": ("Operate", "/"), "sweep": ("Sweep", "/sweep")}


@contextmanager
def frame(page: str) -> Iterator[None]:
    """The bar and, below it, what the block adds."""
    ui.add_css(_STYLE)
    ui.colors(primary="#1d4ed8")
    with ui.header(elevated=False).classes("bar items-center"):
        ui.label("Operator's console").classes("name")
        ui.space()
        for name, (title, address) in _PAGES.items():
            ui.link(title, address).classes("way here" if name == page else "way")
    with ui.column().classes("page"):
        yield


def card() -> ui.element:
    """A white box."""
    return ui.element("div").classes("box")


def number(title: str, kind: str) -> ui.label:
    """A number with its title; returns the label of the number."""
    with ui.element("div").classes("gauge"):
        ui.label(title).classes("title")
        return ui.label("–").classes(f"value {kind}")
