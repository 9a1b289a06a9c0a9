"""The picture of a session in the browser, which receives only what is new."""

from pathlib import Path
from typing import Any

from nicegui import ui

__all__ = ["Scene"]


class Scene(ui.element, component=Path(__file__).parent / "web" / "scene.js"):
    """A canvas that draws quantities over time and the map of the 2-D world.

    Args:
        strips: Names of the quantities.
        scenery: What the map shows, see :meth:`.bench.Bench.scenery`.
    """

    def __init__(self, strips: list[str], scenery: dict[str, Any]) -> None:
        super().__init__()
        self.show(strips, scenery)

    def show(self, strips: list[str], scenery: dict[str, Any]) -> None:
        """Begin another picture."""
        self.props["strips"], self.props["scenery"] = strips, scenery
        self.props["label"] = "what the machine does over time"
        self.update()

    def push(self, step: dict[str, Any]) -> None:
        """Draw a step."""
        self.run_method("push", step)

    def clear(self) -> None:
        """Forget what was drawn."""
        self.run_method("clear")

    def turn(self, arrows: list[list[float]]) -> None:
        """Draw other arrows."""
        self.run_method("turn", arrows)

    def picture(self, address: str) -> None:
        """Show what the camera sees, as a data URL."""
        self.run_method("picture", address)
