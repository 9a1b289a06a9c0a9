"""The page on which an operator turns the proximity while a machine runs."""

import time
from functools import partial
from pathlib import Path
from typing import Any, Final

from nicegui import run, ui
from nicegui.events import ValueChangeEventArguments

from components.evaluation.guarantee import Guarantee
from components.operating.session import Driver
from flows.console.bench import MOST, Bench
from flows.console.catalogue import Catalogue, NotOfferedError
from flows.console.gauges import Gauges
from flows.console.layout import card, frame
from flows.console.scene import Scene
from flows.console.windows import Windows

__all__ = ["Operate"]

_RATES: Final = (5, 10, 20)  # steps a second
_USUAL_RATE: Final = 10
_DRIVERS: Final[dict[Driver, str]] = {
    "operator": "you",
    "behaviour": "behaviour",
    "autopilot": "autopilot",
}


class Operate:
    """One window.

    Args:
        catalogue: What can be chosen.
        windows: All windows.
        sessions: Folder below which recordings are saved.
        guarantee: Of the autopilot.
    """

    def __init__(
        self, catalogue: Catalogue, windows: Windows, sessions: Path, guarantee: Guarantee
    ) -> None:
        self._guarantee = guarantee
        self._catalogue, self._windows, self._sessions = catalogue, windows, sessions
        self._bench: Bench | None = None
        self._filming: Any = None
        self._rate = _USUAL_RATE
        self._next = 0.0
        self._wanted: float | None = None  # setpoint that the operator has demanded

    async def show(self, asked: str) -> None:
        """Build the page; the session begins when the browser is connected.

        Args:
            asked: Id of the policy from the address; empty: the first one.
        """
        offers = await run.io_bound(self._catalogue.offers)
        with frame("operate"):
            with ui.row().classes("w-full items-end gap-4 no-wrap-wide"):
                self._choice = ui.select(
                    {offer.id: offer.title for offer in offers.values()},
                    label="policy",
                    on_change=self._chosen,
                ).classes("grow choice")
                self._drivers = ui.toggle({}, on_change=self._driver).props("no-caps unelevated")
                self._drivers.classes("drivers").mark("drivers")
            self._dial()
            self._said = ui.label().classes("said").mark("said")
            self._warning = ui.label().classes("warning").mark("warning")
            self._warning.set_visibility(False)
            self._gauges = Gauges()
            self._buttons()
            with card():
                self._scene = Scene([], {"map": False, "goals": [], "centre": [0, 0], "side": 1})
                self._legend()
        await ui.context.client.connected()
        if not self._windows.enter(ui.context.client):
            self._say("Too many windows are open; close one and load this page again.")
            return
        ui.context.client.on_delete(self._close_camera)
        ui.timer(1 / max(_RATES), self._tick)
        first = asked or next(iter(offers), "")
        if first in offers:
            self._choice.value = first
        else:
            self._say("There is no such policy; choose one of the list.")

    def _dial(self) -> None:
        with card().classes("dial"):
            with ui.row().classes("w-full items-center justify-between no-wrap"):
                ui.label("familiar").classes("end")
                self._reading = ui.label("λ = 0.00").classes("reading").mark("reading")
                ui.label("better").classes("end")
            self._slider = (
                ui.slider(min=0, max=1, step=0.01, value=0, on_change=self._turned)
                .props('color="primary" thumb-size="30px" track-size="10px" aria-label="proximity"')
                .mark("dial")
            )

    def _legend(self) -> None:
        with ui.row().classes("legend gap-4"):
            self._own_name = ui.label("━ this policy").classes("own")
            self._usual_name = ui.label("━ the behaviour, same start and same noise").classes(
                "usual"
            )
            self._clock = ui.label("").classes("clock").mark("clock")

    def _buttons(self) -> None:
        with ui.row().classes("w-full items-center gap-2 buttons"):
            self._pause = ui.button("Pause", icon="pause", on_click=self._paused).mark("pause")
            ui.button("Step", icon="skip_next", on_click=self._single).props("outline")
            ui.button("Reset", icon="replay", on_click=self._reset).props("outline").mark("reset")
            ui.toggle(
                {rate: f"{rate}/s" for rate in _RATES}, value=_USUAL_RATE, on_change=self._speed
            ).props("no-caps unelevated")
            self._setpoint = ui.number(
                "setpoint", min=0, max=100, step=5, on_change=self._demanded
            ).classes("setpoint")
            self._setpoint.props('debounce="400"').mark("setpoint")
            ui.space()
            ui.button("Save the session", icon="save", on_click=self._save).props("outline").mark(
                "save"
            )
            ui.button("CSV", icon="download", on_click=self._download).props("flat")

    async def _chosen(self, event: ValueChangeEventArguments) -> None:
        self._bench = None
        self._close_camera()
        self._say("Opening …")
        try:
            operable = await run.io_bound(self._catalogue.open, event.value)
            if event.value != self._choice.value:
                return  # another one was chosen meanwhile
            bench = Bench(operable, event.value, guarantee=self._guarantee)
            if self._wanted is not None and bench.session.plant.setpoint is not None:
                bench.session.plant.demand(self._wanted)
        except NotOfferedError:
            self._say("There is no such policy; choose one of the list.")
            return
        except (ValueError, OSError) as error:
            self._say(str(error))
            return
        session = bench.session
        self._scene.show([name for name, _ in bench.strips], bench.scenery())
        real = session.plant.real
        self._usual_name.text = (
            "━ the behaviour, same start and same noise" if real else "━ what was logged"
        )
        self._drivers.set_options({d: _DRIVERS[d] for d in session.drivers}, value="operator")
        self._setpoint.set_visibility(session.plant.setpoint is not None)
        self._setpoint.value = session.plant.setpoint
        self._slider.set_enabled(session.takes_proximity)
        self._read(float(self._slider.value or 0.0) if session.takes_proximity else None)
        self._gauges.of(real)
        said = [] if session.takes_proximity else ["This policy takes no proximity to be turned."]
        if not real:
            said.append("No system is known here: the policy is shown on recorded states.")
        if bench.drawable:
            from flows.console.camera import filmed  # imports MuJoCo, which only robots need

            self._filming = filmed(
                bench, lambda: self._bench is bench, self._scene.picture, self._say
            )
        self._say(" ".join(filter(None, said)))
        session.proximity = float(self._slider.value or 0.0) if session.takes_proximity else 0.0
        self._bench = bench
        self._show_pause()
        self._turn_map()

    def _close_camera(self) -> None:
        if self._filming is not None:
            self._filming.close()
        self._filming = None

    def _tick(self) -> None:
        bench, now = self._bench, time.monotonic()
        if bench is None or not bench.running or now < self._next:
            return
        # A late tick delays the following ones by less than a step, and never makes a burst.
        self._next = max(self._next + 1 / self._rate, now - 1 / self._rate)
        self._act(bench)

    def _act(self, bench: Bench) -> None:
        self._scene.push(bench.step())
        session = bench.session
        if session.driver == "autopilot":
            self._slider.value = round(session.proximity, 2)
            self._turn_map()
            if bench.pilot is not None:
                self._say(f"{bench.pilot.said} {bench.pilot.promise}")
        if self._filming is not None:
            self._filming.look()
        self._show_numbers(bench)
        if bench.full:
            self._say(f"{MOST:,} steps are recorded; save the session, or reset it to go on.")
            self._show_pause()

    def _show_numbers(self, bench: Bench) -> None:
        session, done = bench.session, bench.last
        self._gauges.show(session, done)
        self._clock.text = f"episode {done.episode + 1}, step {done.step + 1}"
        self._warning.set_visibility(session.strayed)
        if session.strayed:
            self._warning.text = (
                "⚠ The state has left the log: nobody knows from experience what happens here. "
                "Turn back towards familiar, or watch closely."
            )

    def _read(self, proximity: float | None) -> None:
        """Show the proximity; a policy that takes none has none."""
        self._reading.text = "no λ" if proximity is None else f"λ = {proximity:.2f}"

    def _turned(self, event: ValueChangeEventArguments) -> None:
        self._read(float(event.value or 0.0))
        if self._bench is not None and self._bench.session.driver != "autopilot":
            self._bench.turn(event.value)
            self._turn_map()

    def _turn_map(self) -> None:
        if self._bench is not None and (arrows := self._bench.arrows()) is not None:
            self._scene.turn(arrows)

    def _driver(self, event: ValueChangeEventArguments) -> None:
        if self._bench is not None and event.value in self._bench.session.drivers:
            self._bench.session.driver = event.value
            self._slider.set_enabled(event.value == "operator")
            self._say("")
            if event.value == "operator":
                self._bench.turn(self._slider.value)
                self._turn_map()

    def _demanded(self, event: ValueChangeEventArguments) -> None:
        if self._bench is None or event.value is None:
            return
        try:
            self._bench.session.plant.demand(float(event.value))
            self._wanted = float(event.value)
        except (ValueError, TypeError) as error:
            self._say(str(error))

    def _paused(self) -> None:
        if self._bench is not None:
            self._bench.running = not self._bench.running and not self._bench.full
            self._show_pause()

    def _single(self) -> None:
        if self._bench is not None and not self._bench.full:
            self._bench.running = False
            self._show_pause()
            self._act(self._bench)

    def _reset(self) -> None:
        if self._bench is not None:
            self._bench.restart()
            self._scene.clear()
            self._warning.set_visibility(False)
            self._show_pause()

    def _speed(self, event: ValueChangeEventArguments) -> None:
        if event.value in _RATES:
            self._rate = event.value

    def _show_pause(self) -> None:
        running = self._bench is not None and self._bench.running
        self._pause.text = "Pause" if running else "Go on"
        self._pause.icon = "pause" if running else "play_arrow"

    async def _save(self) -> None:
        if self._bench is None:
            return
        try:
            place = await run.io_bound(partial(self._bench.save, self._sessions))
        except OSError as error:
            self._say(f"The session cannot be saved: {error}.")
            return
        said = f"Saved: {place}. Replay it with python -m flows.console replay={place}"
        if self._bench is not None and self._bench.recording.is_log:
            said += (
                f", or import it with python -m flows.import_log {place}/session.csv name=session "
                f"schema={place}/session.yaml short=drop"
            )
        else:
            said += ". It is no log to learn from: what was proposed had no effect."
        self._say(said)

    def _download(self) -> None:
        if self._bench is not None:
            ui.download.content(self._bench.recording.table, "session.csv")

    def _say(self, text: str) -> None:
        self._said.text = text
        self._said.set_visibility(bool(text))
