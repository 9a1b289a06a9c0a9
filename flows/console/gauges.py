"""The numbers below the dial: what was earned, and how far from the log it happens."""

from nicegui import ui

from components.operating.session import Session, Step
from flows.console.layout import number

__all__ = ["Gauges"]


class Gauges:
    """A row of numbers."""

    def __init__(self) -> None:
        with ui.element("div").classes("gauges"):
            self._own = number("reward so far: this policy", "own")
            self._usual = number("reward so far: behaviour", "usual")
            self._better = number("gain per step", "")
            self._distance = number("action: distance to the familiar", "")
            self._strange = number("state: distance to the log", "")

    def of(self, real: bool) -> None:
        """Prepare for a system, or for recorded states, on which no policy earns anything."""
        for label in (self._own, self._usual, self._better):
            label.parent_slot.parent.set_visibility(real)

    def show(self, session: Session, step: Step) -> None:
        """Show a step and what was earned until now."""
        own, usual = (float(value) for value in session.sums)
        self._own.text, self._usual.text = f"{own:.1f}", f"{usual:.1f}"
        gain = (own - usual) / max(1, session.at)
        self._better.text = f"{gain:+.3f}"
        self._better.classes(
            add="good" if gain > 0 else "bad", remove="bad" if gain > 0 else "good"
        )
        self._distance.text = f"{step.distance:.2f}"
        strange = step.strangeness
        self._strange.text = "–" if strange != strange else f"{strange:.2f}"
