"""Where judged policies lead: the values of a plant that the ensemble expects, beside the log's."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import pandas as pd

__all__ = ["Lead", "lead_table", "leads_of", "strays"]

_MARGIN: Final = 0.1  # of the log's own range, by which it may be left without a word


@dataclass(frozen=True)
class Lead:
    """Values of a column of the state, in the units of the log.

    Attributes:
        feature: Name of the column.
        low: Below it lies 1 % of what is expected.
        high: Above it lies 1 %.
        least: Of the judges' part of the log.
        greatest: Likewise.
    """

    feature: str
    low: float
    high: float
    least: float
    greatest: float

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
    ends = frames.groupby(keys, dropna=False, sort=False).agg(widest).reset_index()
    for row in ends.to_dict("records"):
        at = None if math.isnan(row["proximity"]) else float(row["proximity"])
        lead = Lead(str(row["feature"]), *(float(row[name]) for name in widest))
        found.setdefault((str(row["algorithm"]), at), []).append(lead)
    return found


def strays(name: str, leads: Sequence[Lead]) -> list[str]:
    """A sentence if a policy is expected to leave the range of the log by more than a tenth."""
    said = [lead.stray for lead in leads if lead.stray]
    if not said:
        return []
    return [f"Beyond the judges' part of the log, {name} is expected to lead {'; '.join(said)}."]


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
            row[name] = f"{lead.low:.4g} to {lead.high:.4g}"
    return pd.DataFrame(list(rows.values()))
