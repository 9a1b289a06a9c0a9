"""Reads an artifact folder for its MLflow run: parameters, curves, numbers, data sets."""

import errno
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from components.core.arrays import load_arrays
from components.core.integrity import load_json
from components.core.sealed import check_folder
from flows.pipeline.task import READ

__all__ = ["RunContent", "flat", "link_tree", "read_content"]

_POINTS = 200  # per curve; the whole curve stays in the artifact
_LENGTH = 5900  # of a parameter; MLflow cuts at 6000
_MEASURED = ("wall_seconds", "seconds", "cpu_seconds", "peak_rss_mib")


@dataclass(frozen=True)
class RunContent:
    """The content of a run besides the node itself.

    Attributes:
        record: The artifact's `node.json`.
        params: Further parameters.
        tags: Further tags.
        metrics: (name, value, milliseconds since 1970, step).
        datasets: Data sets that were read: name, digest, source.
    """

    record: Mapping[str, Any]
    params: Mapping[str, str]
    tags: Mapping[str, Any]
    metrics: list[tuple[str, float, int, int]]
    datasets: list[Mapping[str, Any]]


def read_content(folder: Path) -> RunContent:
    """Reads an artifact folder; the files of the task contract are all optional.

    Raises:
        DamagedFileError: one of them, or `node.json`, is damaged.
    """
    record = check_folder(folder, READ)
    last = int(1000 * record["finished"])
    first = int(1000 * record["started"])
    metrics = _curves(folder / "curves.npz", first, last)
    # A name that is both a curve and a final number keeps its curve and gets the number at its end.
    ends = {name: step for name, _, _, step in metrics}
    finals = dict(_optional(folder / "metrics.json") or {})
    # Named to sort last: the charts page opens with what was learned, not with the cost.
    finals |= {f"usage/{name}": record[name] for name in _MEASURED if name in record}
    metrics += [
        (_name(name), float(value), last, ends.get(_name(name), 0))
        for name, value in finals.items()
        if value is not None
    ]
    params = flat(_optional(folder / "params.json") or {})
    params |= {name: str(record[name]) for name in ("hardware", "package") if name in record}
    return RunContent(
        record=record,
        params=params,
        tags=_optional(folder / "tags.json") or {},
        metrics=metrics,
        datasets=_optional(folder / "datasets.json") or [],
    )


def _optional(path: Path) -> Any:
    return load_json(path) if path.exists() else None


def _curves(path: Path, first: int, last: int) -> list[tuple[str, float, int, int]]:
    if not path.exists():
        return []
    points = []
    arrays = load_arrays(path)
    for name in (name.removesuffix("/value") for name in arrays if name.endswith("/value")):
        steps, values = arrays[f"{name}/step"], arrays[f"{name}/value"]
        if len(values) == 0:
            continue
        kept = np.unique(np.linspace(0, len(values) - 1, _POINTS).round().astype(int))
        # When each point was reached is not stored; a steady pace is close enough for the axis.
        times = first + (last - first) * (kept + 1) // len(values)
        points += [
            (_name(name), float(values[i]), int(at), int(steps[i]))
            for i, at in zip(kept, times, strict=True)
        ]
    return points


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested settings as one level of text, with the names and lengths that MLflow takes."""
    result: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            result |= flat(value, f"{prefix}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, default=str)
            result[_name(f"{prefix}{name}")] = text[:_LENGTH]
    return result


def _name(name: str) -> str:
    return re.sub(r"[^\w\-. /:]", "_", str(name), flags=re.ASCII)[:250]


def link_tree(source: Path, target: Path) -> None:
    """Gives every file of a folder a second name in another one, or copies it to another disk.

    A name that belongs to another file there, such as a damaged one, is taken from it.
    """
    for folder, _, names in os.walk(source):
        place = target / Path(folder).relative_to(source)
        place.mkdir(parents=True, exist_ok=True)
        for name in names:
            file, second = Path(folder) / name, place / name
            if second.exists():
                if second.samefile(file):
                    continue
                second.unlink()
            try:
                os.link(file, second)
            except OSError as error:
                # Some file systems know no second names, others have used them all up.
                if error.errno not in (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP):
                    raise
                shutil.copy2(file, second)
