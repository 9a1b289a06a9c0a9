"""The page on policies that were judged from a log alone, and its part in the other page."""

from collections.abc import Sequence
from typing import Any, Final

from components.reporting.frame import asked_for, html_table, rendered, total_hours
from components.reporting.glossary import JUDGED_GLOSSARY
from components.reporting.judged import Choice, Judged, JudgedLog, choice_table, digits_of
from components.reporting.page_data import colours, plain
from components.reporting.promises import promise
from components.reporting.trial import FAR

__all__ = ["JUDGED_PARTS", "judged_content", "judged_data", "judged_page"]

JUDGED_PARTS: Final = (
    ("verdicts", "In plain words"),
    ("promises", "Expected gain over λ"),
    ("policies", "All judged policies"),
    ("logs", "Logs"),
    ("costs", "Costs"),
    ("repeat", "Repeat it"),
    ("glossary", "Glossary"),
)
"""Ids and short names of the page's parts, in their order."""


def judged_page(judged: Judged) -> str:
    """The whole page."""
    return rendered(
        "judged.html.j2",
        ["judged.js"],
        {
            "budget": judged.budget,
            "algorithms": [
                {"name": name, "colour": colour}
                for name, colour in colours(judged.algorithms).items()
            ],
            "judged": judged_data(judged.logs),
        },
        judged.algorithms,
        title=f"Judged from the log: {', '.join(judged.sweeps)}",
        asked=asked_for(judged.sweeps),
        budget=judged.budget,
        parts=JUDGED_PARTS,
        judged=judged_content(judged.logs),
        total=total_hours(judged.costs),
        costs=html_table(judged.costs),
        software=html_table(judged.software),
        sweeps=judged.sweeps,
        notes=judged.notes,
        glossary=JUDGED_GLOSSARY,
    )


def judged_content(logs: Sequence[JudgedLog]) -> list[dict[str, Any]]:
    """What templates show of every log."""
    return [
        {
            "name": log.name,
            "promise": (said := promise(log)),
            "leads": None if said.leads.empty else html_table(said.leads),
            "figure": f"figure-judged-{number}",
            "facts": log.facts,
            "table": html_table(choice_table(log), digits_of(log)) if log.choices else None,
        }
        for number, log in enumerate(logs)
    ]


def judged_data(logs: Sequence[JudgedLog]) -> list[dict[str, Any]]:
    """What the script draws, log by log; what is not finite is null."""
    return [
        {
            "name": log.name,
            "decimals": log.decimals,
            "far": FAR,
            "best": None if log.best is None else plain([log.best.algorithm, log.best.proximity]),
            "usually_outside": plain(log.choices[0].usually_outside) if log.choices else None,
            "curves": [
                {"algorithm": name, "points": [_point(choice) for choice in own]}
                for name, own in _by_algorithm(log).items()
            ],
        }
        for log in logs
    ]


def _by_algorithm(log: JudgedLog) -> dict[str, list[Choice]]:
    """The choices of every algorithm, the smallest λ first."""
    found: dict[str, list[Choice]] = {}
    for choice in log.choices:
        found.setdefault(choice.algorithm, []).append(choice)
    return {name: sorted(own, key=lambda c: c.proximity or 0.0) for name, own in found.items()}


def _point(choice: Choice) -> dict[str, Any]:
    model = choice.model
    return {
        "proximity": choice.proximity,
        "ensemble": None if model is None else plain([model.value, model.error]),
        "critics": plain([choice.critics.value, choice.critics.error]),
        "outside": plain(choice.outside),
    }
