"""What a sweep is doing: ``python -m flows.status [sweep=NAME] [--watch] [--json]``."""

import json
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext

from rich.console import Console
from rich.live import Live
from rich.text import Text

from components.core.files import without_undefined
from flows.configuration.checking import SettingsError, build_config
from flows.configuration.words import fields_of_words
from flows.door import run_door
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord, read_sweep
from flows.status.shown import as_values, lines
from flows.status.sweep_state import SweepState, read_state
from flows.status.sweeps import SweepWords, chosen, listed, open_store
from flows.status.table import results, table_text

__all__ = ["StatusWords", "load_status_words", "status"]

HELP = """\
usage: python -m flows.status [sweep=NAME] [--watch] [--json]

Tell what a sweep is doing: what is finished, running (how far, how long still, where), failed and
missing, by algorithm and dataset, and the table so far. Everything is read from the store, from any
terminal and any computer that sees it, while the sweep runs or afterwards; nothing is written.

  sweep=NAME     of a sweep in the store; may be left out if there is only one, or one that runs
  --watch        again every few seconds until no driver runs, or Ctrl-C
  --json         for programs: one JSON object; with --watch one per line
  store=mlruns   folder of the runs
"""

_EVERY = 5.0  # seconds between two looks
_LIVING = ("running", "stopping")


class StatusWords(SweepWords):
    """Which sweep, and how it is shown."""

    watch: bool = False
    json_: bool = False


def load_status_words(words: Sequence[str]) -> StatusWords:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    fields = fields_of_words(words, switches=["watch", "json"])
    if "json" in fields:  # pydantic has a method of this name
        fields["json_"] = fields.pop("json")
    made: StatusWords = build_config(StatusWords, "", fields)
    return made


def status(words: StatusWords, pause: Callable[[float], object] = time.sleep) -> int:
    """Show the state of a sweep, or the list of sweeps.

    Args:
        words: Settings.
        pause: Waits so many seconds.

    Returns:
        The exit code.

    Raises:
        SettingsError: There is no such sweep.
        ValueError: A record or a result is damaged.
    """
    store = open_store(words)
    record = chosen(store, words.sweep)
    if record is None:
        if words.watch:
            raise SettingsError("There are several sweeps; name the one to watch: sweep=NAME.")
        _list(store, words)
    elif words.watch:
        _watch(store, record, words, pause)
    else:
        state = read_state(store, record)
        print(_json(state, store, indent=1) if words.json_ else _text(state, store))
    return 0


def _list(store: ArtifactStore, words: StatusWords) -> None:
    sweeps = listed(store)
    if words.json_:
        rows = [
            {"sweep": s.record.name, "state": s.phase, "nodes": len(s.record.nodes), "done": s.done}
            for s in sweeps
        ]
        print(json.dumps({"sweeps": rows}, indent=1))
        return
    print(f"The sweeps of {words.store}/; sweep=NAME tells more of one:")
    wide = max(len(sweep.record.name) for sweep in sweeps)
    for sweep in sweeps:
        said = {"unknown": "no driver is known", "ended": "ended", "killed": "driver killed"}
        phase = said.get(sweep.phase, sweep.phase)
        total = len(sweep.record.nodes)
        print(f"  {sweep.record.name:<{wide}}  {sweep.done:>6,} of {total:>6,} nodes  {phase}")


def _watch(
    store: ArtifactStore,
    record: SweepRecord,
    words: StatusWords,
    pause: Callable[[float], object],
) -> None:
    path = store.root / "sweeps" / f"{record.name}.json"
    console = Console(highlight=False)
    in_place = console.is_terminal and not words.json_
    live = Live(console=console, auto_refresh=False) if in_place else None
    with live or nullcontext():
        while True:
            state = read_state(store, read_sweep(path))
            if words.json_:
                print(_json(state, store), flush=True)
            elif live is not None:
                live.update(Text(_text(state, store)), refresh=True)
            else:
                print(f"{_text(state, store)}\n", flush=True)
            if state.phase not in _LIVING:
                return
            pause(_EVERY)
            store.look_again()


def _text(state: SweepState, store: ArtifactStore) -> str:
    # A file or a pipe has lines as long as they are.
    width = shutil.get_terminal_size(fallback=(10_000, 0)).columns
    said = lines(state, time.time(), width)
    table = table_text(state, store, results(state, store), width)
    return "\n".join([*said, *(["", table.rstrip()] if table else [])])


def _json(state: SweepState, store: ArtifactStore, indent: int | None = None) -> str:
    table = results(state, store)
    rows = without_undefined(table.to_dict("records"))
    return json.dumps(as_values(state, rows), indent=indent, allow_nan=False)


if __name__ == "__main__":
    run_door("status", HELP, load_status_words, status)
