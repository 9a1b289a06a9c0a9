"""Published results: a folder with the returns of all policies, from which its table is made again.

`policies.parquet` holds the returns, `about.json` what they cannot tell: the commands, and which of
the thesis's values may stand beside them.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from components.aggregation.intervals import seed_interval
from components.aggregation.statistics import summarise
from components.core.files import write_json
from components.core.integrity import load_json
from components.reporting.evidence import Evidence
from components.reporting.overview import Thesis, overview
from components.reporting.overview_text import markdown_overview
from components.reporting.policies import policy_table
from components.reporting.tables import result_table

__all__ = ["ABOUT", "POLICIES", "publish", "published_table"]

POLICIES: Final = "policies.parquet"
ABOUT: Final = "about.json"
_REMEDY: Final = "write it again by python -m flows.report"


def publish(folder: Path, evidence: Evidence) -> list[Path]:
    """Write the data behind a report.

    Args:
        folder: Which exists.
        evidence: Of the report.

    Returns:
        The files.
    """
    files = [folder / POLICIES, folder / ABOUT]
    policy_table(evidence).to_parquet(files[0], index=False)
    thesis = [
        {"dataset": dataset, "algorithm": algorithm, **asdict(value)}
        for (dataset, algorithm), value in evidence.thesis.items()
    ]
    footnotes = dict(evidence.table.footnotes)
    about = {"sweeps": dict(evidence.sweeps), "budget": evidence.budget, "thesis": thesis}
    write_json(files[1], about | {"footnotes": footnotes, "notes": list(evidence.notes)})
    return files


def published_table(folder: Path) -> str:
    """The overview of published results with its notes, as Markdown, made from their policies.

    Raises:
        DamagedFileError: A file is missing or damaged.
    """
    about = load_json(folder / ABOUT, _REMEDY)
    policies = pd.read_parquet(folder / POLICIES)
    levels = policies.groupby("dataset", sort=False)["logged"].first()
    logged = {str(name): None if np.isnan(level) else level for name, level in levels.items()}
    thesis = {
        (own.pop("dataset"), own.pop("algorithm")): Thesis(**own)
        for own in map(dict, about["thesis"])
    }
    table = overview(result_table(_summaries(policies)), logged, thesis, about["footnotes"])
    notes = "".join(f"\n{note}\n" for note in [*table.notes(), *about["notes"]])
    commands = "".join(f"    {command}\n" for command in about["sweeps"].values())
    return f"{markdown_overview(table)}{notes}\nMade by\n\n{commands}"


def _summaries(policies: pd.DataFrame) -> Iterator[Mapping[str, Any]]:
    """Summaries as aggregation makes them, of the pooled policies."""
    pooled = policies[policies["pooled"]]
    for (dataset, algorithm), own in pooled.groupby(["dataset", "algorithm"], sort=False):
        seeds = [int(seed) for seed in own["seed"].unique()]
        points = []
        places = own["proximity"].unique().tolist()
        for place in places:
            rows = own[own["proximity"].isna() if np.isnan(place) else own["proximity"] == place]
            pool = np.stack([rows.loc[rows["seed"] == seed, "return"] for seed in seeds])
            low, high = seed_interval(pool)
            point = {"lambda": None if np.isnan(place) else place}
            point |= summarise(pool.ravel()).as_dict()
            points.append(point | {"interval_low": float(low), "interval_high": float(high)})
        yield {"dataset": dataset, "algorithm": algorithm, "seeds": seeds, "points": points}
