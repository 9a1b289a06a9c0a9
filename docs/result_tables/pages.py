"""The pages that hold tables, and their tables by name."""

import re
from collections.abc import Callable, Mapping
from typing import Final

from docs.result_tables import benchmark, every_cell, judging, safety, settings
from docs.result_tables.shared import ROOT

PAGES: Final = (
    ROOT / "README.md",
    *(
        ROOT / "docs" / f"{n}.md"
        for n in ("results", "world", "judging", "studies", "autopilot", "caution")
    ),
)

TABLES: Final[Mapping[str, Callable[[], str]]] = {
    "front": benchmark.front,
    "full": benchmark.full,
    "beside": benchmark.beside,
    "every_turbine": every_cell.turbine,
    "every_robot": every_cell.robots,
    "every_budget": every_cell.budgets,
    "ddpg": every_cell.ddpg,
    "free_halt": every_cell.free_halt,
    "world": settings.world,
    "bad_alone": settings.bad_alone,
    "box": settings.box,
    "autoencoder": settings.autoencoder,
    "pace": settings.pace,
    "limits": settings.limits,
    "swarm": settings.swarm,
    "judges": judging.judges,
    "judged": judging.judged,
    "blind": judging.blind,
    "lion_over_lambda": lambda: settings.study("figure-6.5"),
    "autopilot": safety.autopilot,
    "autopilot_slopes": safety.autopilot_slopes,
    "warnings": safety.warnings,
    "caution": safety.caution,
    "caution_by": safety.caution_by,
    "first_drop": lambda: settings.study("table-6.1"),
    "online": lambda: settings.study("figure-2.3"),
    "without_models": lambda: settings.study("figure-6.12"),
    "unconstrained": lambda: settings.study("figure-2.4"),
    "beta": lambda: settings.study("figure-6.10"),
    "ensemble": lambda: settings.study("figure-6.11"),
    "eta": settings.chosen_blind,
    "dials": settings.dials,
    "dials_means": settings.dials_means,
}


def filled(text: str) -> str:
    """A page with its tables made anew.

    Raises:
        KeyError: It asks for a table that is none of `TABLES`.
    """

    def table(found: re.Match[str]) -> str:
        name = found[1]
        return f"<!-- table {name} -->\n\n{TABLES[name]()}\n<!-- end of {name} -->"

    return re.sub(r"<!-- table (\w+) -->.*?<!-- end of \1 -->", table, text, flags=re.DOTALL)


def main() -> None:
    """Write the pages."""
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
