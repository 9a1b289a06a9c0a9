"""The state of a sweep as text, and as plain values for JSON."""

from collections.abc import Mapping, Sequence
from typing import Any

from flows.pipeline.progress import duration
from flows.status.grid import Part, cells, components, grid
from flows.status.sweep_state import SweepState

__all__ = ["as_values", "headline", "lines"]

_GAP = "  "
_ERRORS = 3  # failed nodes that are named, the newest; --json names all
_LEGEND = "Cells (seeds) finished of all; ▶ running, ✗ failed or in need of a failed node."


def headline(state: SweepState, now: float) -> str:
    """What the driver of a sweep is doing, in one sentence.

    Args:
        state: Of the sweep.
        now: Seconds since 1970.
    """
    driver, name = state.driver, state.record.name
    resume = f"Continue with: {state.record.command}"
    if driver is None:
        return f"Sweep {name}: whether a driver runs is not known. {resume}"
    place = f"{driver.host} (process {driver.pid})"
    seen = duration(max(0.0, now - driver.beat))
    match state.phase:
        case "running":
            limit = f"; stops {driver.limit}" if driver.limit else ""
            since = duration(max(0.0, now - driver.began))
            return f"Sweep {name}: running on {place} for {since}{limit}."
        case "stopping":
            return f"Sweep {name}: stopping on {place}, since {driver.stopping}."
        case "killed":
            said = f"its driver on {place} is gone, last seen {seen} ago"
            return f"Sweep {name}: no driver runs; {said}. {resume}"
    if driver.ended == "FINISHED" and len(state.done) == len(state.record.nodes):
        return f"Sweep {name}: finished."
    why = f", since {driver.stopping}" if driver.stopping else ""
    return f"Sweep {name}: no driver runs; the last one ended {seen} ago{why}. {resume}"


def lines(state: SweepState, now: float, width: int) -> list[str]:
    """Everything but the table of results.

    Args:
        state: Of the sweep.
        now: Seconds since 1970.
        width: Of the window in characters.
    """
    said = [headline(state, now), _amount(state)]
    if state.plan is None:
        said.append(
            "Its record holds no plan, being that of a search or of an older version: what is "
            "missing is known by name alone (--json lists it)."
        )
    else:
        said += ["", *_components(components(state)), *_grid(state, width)]
    if state.calls:
        said += ["", *_calls(state)]
    failed = list(state.failed.items())
    if failed:
        said.append("")
        said += [f"failed {state.record.nodes[key]}: {why}" for key, why in failed[-_ERRORS:]]
        if len(failed) > _ERRORS:
            said.append(f"and {len(failed) - _ERRORS} more before")
    return said


def _amount(state: SweepState) -> str:
    number, total = len(state.done), len(state.record.nodes)
    counts = cells(state)
    of_cells = f"{counts['done']:,} of {counts['total']:,} cells and " if counts else ""
    failed = f", {len(state.failed)} failed" if state.failed else ""
    skipped = f", {len(state.skipped)} cannot run without these" if state.skipped else ""
    left = ""
    if state.remaining is not None:
        slots = state.driver.slots if state.driver else 1
        left = f"; about {duration(state.remaining)} left with {slots} at once ({state.source})"
    return f"{of_cells}{number:,} of {total:,} nodes are finished{failed}{skipped}{left}."


def _components(parts: Mapping[str, Part]) -> list[str]:
    rows = [["component", "finished", "running", "failed", "missing", "work done"]]
    for name, part in parts.items():
        numbers = (part.running, part.failed, part.missing)
        shown = [str(number) if number else "" for number in numbers]
        row = [name.replace("_", " "), f"{part.done}/{part.total}", *shown]
        rows.append([*row, f"{part.fraction:.0%}"])
    return _aligned(rows)


def _grid(state: SweepState, width: int) -> list[str]:
    parts = grid(state)
    if not parts:
        return []
    algorithms = list(dict.fromkeys(algorithm for algorithm, _ in parts))
    datasets = list(dict.fromkeys(dataset for _, dataset in parts))
    rows = [["dataset", *algorithms]]
    for dataset in datasets:
        found = [parts.get((algorithm, dataset)) for algorithm in algorithms]
        rows.append([dataset, *("" if part is None else _cell(part) for part in found)])
    said = ["", _LEGEND]
    for block in _blocks(rows, width):
        said += ["", *_aligned(block)]
    return said


def _cell(part: Part) -> str:
    marks = (f" ▶{part.running}" if part.running else "", f" ✗{part.failed}" if part.failed else "")
    return f"{part.done}/{part.total}{''.join(marks)}"


def _blocks(rows: Sequence[Sequence[str]], width: int) -> list[list[list[str]]]:
    """Columns that fit into the window beside the first, again and again."""
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    blocks: list[list[int]] = []
    room = 0
    for number in range(1, len(wide)):
        room -= wide[number] + len(_GAP)
        if room < 0 or not blocks:
            blocks.append([])
            room = width - wide[0] - wide[number] - len(_GAP)
        blocks[-1].append(number)
    return [[[row[0], *(row[n] for n in block)] for row in rows] for block in blocks]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        _GAP.join(
            [row[0].ljust(wide[0]), *(c.rjust(w) for c, w in zip(row[1:], wide[1:], strict=True))]
        ).rstrip()
        for row in rows
    ]


def _calls(state: SweepState) -> list[str]:
    device = state.driver.device if state.driver else ""
    rows = [["running", "done", "left", "on", "process"]]
    for call in state.calls:
        first = state.record.nodes[call.nodes[0]]
        more = f" and {len(call.nodes) - 1} more" if len(call.nodes) > 1 else ""
        left = "" if call.remaining is None else duration(call.remaining)
        place = f"{call.host} {device}".strip()
        rows.append([first + more, f"{call.fraction:.0%}", left, place, str(call.pid)])
    return _aligned(rows)


def as_values(state: SweepState, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Everything, for machines.

    Args:
        state: Of the sweep.
        results: Rows of the table so far.
    """
    names, driver, active = state.record.nodes, state.driver, state.fractions
    told = ("host", "pid", "began", "beat", "slots", "device", "limit", "stopping", "ended")
    ended = {*state.done, *state.failed, *state.skipped, *active}
    return {
        "sweep": state.record.name,
        "command": state.record.command,
        "state": state.phase,
        "driver": None if driver is None else {name: getattr(driver, name) for name in told},
        "remaining_seconds": state.remaining,
        "estimate": state.source,
        "nodes": {
            "total": len(names),
            "done": len(state.done),
            "running": len(active),
            "failed": len(state.failed),
            "skipped": len(state.skipped),
        },
        "cells": dict(cells(state)),
        "components": {name: part.numbers() for name, part in components(state).items()},
        "grid": [
            {"algorithm": algorithm, "dataset": dataset, **part.numbers()}
            for (algorithm, dataset), part in grid(state).items()
        ],
        "running": [
            {
                "nodes": [names[key] for key in call.nodes],
                "fraction": call.fraction,
                "remaining_seconds": call.remaining,
                "host": call.host,
                "pid": call.pid,
            }
            for call in state.calls
        ],
        "failed": [{"node": names[k], "key": k, "error": why} for k, why in state.failed.items()],
        "skipped": [{"node": names[k], "needs": names.get(n, n)} for k, n in state.skipped.items()],
        "missing": [name for key, name in names.items() if key not in ended],
        "results": list(results),
    }
