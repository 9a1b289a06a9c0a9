"""Where judged policies lead: the values of a plant that the ensemble expects, beside the log's.

Predictions of an ensemble are held between the least and the greatest values that it was fitted to.
A policy that would leave the log therefore shows by how often it is held at an end of it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import pandas as pd

__all__ = ["Lead", "lead_table", "leads_of", "strays"]

_MARGIN: Final = 0.1  # of the log's own range, by which it may be left without a word
_HELD: Final = 0.1  # of the steps more than under the behaviour, from which it is worth a word


@dataclass(frozen=True)
class Lead:
    """Values of a column of the state, in the units of the log.

    Attributes:
        feature: Name of the column.
        low: Below it lies 1 % of what is expected.
        high: Above it lies 1 %.
        least: Of the judges' part of the log.
        greatest: Likewise.
        held_low: Share of the steps in which the ensemble is held at its least value.
        held_high: At its greatest.
        held_low_usual: The same under the behaviour policy.
        held_high_usual: Likewise.
    """

    feature: str
    low: float
    high: float
    least: float
    greatest: float
    held_low: float = 0.0
    held_high: float = 0.0
    held_low_usual: float = 0.0
    held_high_usual: float = 0.0

    @property
    def stray(self) -> str:
        """How it leaves the log's range, in words; empty where it hardly does."""
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            return f"{self.feature} to where it is not finite"
        width = (self.greatest - self.least) or abs(self.greatest)  # of a column that is constant
        ends = []
        if self.low < self.least - _MARGIN * width:
            ends.append(f"down to {self.low:.4g} (at least {self.least:.4g} there)")
        if self.high > self.greatest + _MARGIN * width:
            ends.append(f"up to {self.high:.4g} (at most {self.greatest:.4g} there)")
        return f"{self.feature} {' and '.join(ends)}" if ends else ""

    @property
    def held(self) -> str:
        """At which end of the log it is held more than usual, in words; empty where at none."""
        ends = [
            f"{self.feature} at {value:.4g}, the {end} that it knows, in {share:.0%} of the steps"
            for end, value, share, usual in (
                ("least", self.low, self.held_low, self.held_low_usual),
                ("greatest", self.high, self.held_high, self.held_high_usual),
            )
            if share > usual + _HELD
        ]
        return " and ".join(ends)

    @property
    def expected(self) -> str:
        """Its range in words."""
        shares = {"least": self.held_low, "greatest": self.held_high}
        held = "".join(f", {s:.0%} at the {end}" for end, s in shares.items() if s > _HELD)
        return f"{self.low:.4g} to {self.high:.4g}{held}"


def leads_of(frames: pd.DataFrame) -> dict[tuple[str, float | None], list[Lead]]:
    """Where policies lead, by algorithm and λ: the widest ends of all seeds and snapshots.

    Args:
        frames: Of one log, a row per policy and column of its state: ``algorithm``, ``proximity``,
            ``feature``, ``low``, ``high``, ``least``, ``greatest``.
    """
    found: dict[tuple[str, float | None], list[Lead]] = {}
    if frames.empty:
        return found
    keys = ["algorithm", "proximity", "feature"]
    widest = {"low": "min", "high": "max", "least": "min", "greatest": "max"}
    widest |= {f"held_{end}{usual}": "max" for usual in ("", "_usual") for end in ("low", "high")}
    ends = frames.groupby(keys, dropna=False, sort=False).agg(widest).reset_index()
    for row in ends.to_dict("records"):
        at = None if math.isnan(row["proximity"]) else float(row["proximity"])
        lead = Lead(str(row["feature"]), *(float(row[name]) for name in widest))
        found.setdefault((str(row["algorithm"]), at), []).append(lead)
    return found


def strays(name: str, leads: Sequence[Lead]) -> list[str]:
    """Sentences if a policy is expected to leave the range of the log, or would if it could."""
    said = []
    if beyond := [lead.stray for lead in leads if lead.stray]:
        said.append(
            f"Beyond the judges' part of the log, {name} is expected to lead {'; '.join(beyond)}."
        )
    if held := [lead.held for lead in leads if lead.held]:
        said.append(
            f"Under {name} the ensemble stops at the edge of the judges' part of the log: "
            f"{'; '.join(held)}. It cannot tell what lies beyond, and the plant may go on there."
        )
    return said


def lead_table(leads: Mapping[str, Sequence[Lead]]) -> pd.DataFrame:
    """A row per column of the state: its values in the log, and where some policies lead it.

    Args:
        leads: By the name of the policy.
    """
    rows: dict[str, dict[str, str]] = {}
    for name, own in leads.items():
        for lead in own:
            logged = f"{lead.least:.4g} to {lead.greatest:.4g}"
            row = rows.setdefault(lead.feature, {"column": lead.feature, "log": logged})
            row[name] = lead.expected
    return pd.DataFrame(list(rows.values()))
