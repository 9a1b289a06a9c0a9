"""What the cells of a sweep have cost, and on what they were computed."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import pandas as pd

from flows.report.stored_nodes import StoredNode

__all__ = ["cost_table", "software_table"]

_HOUR, _MINUTE, _GIB = 3600.0, 60.0, 1024.0
_KINDS = {
    "data_generation": "the log",
    "model_fitting": "model",
    "policy_training": "training",
    "evaluation": "evaluation",
    "judgement": "judging",
}


def cost_table(parts: Mapping[str, Sequence[StoredNode]]) -> pd.DataFrame:
    """A row per algorithm and model: runs, hours, minutes a run, memory.

    Runs that were computed together share the time of their call in equal parts.

    Args:
        parts: Finished nodes by the suffix of their labels.
    """
    found: dict[tuple[str, str], list[StoredNode]] = {}
    for suffix, nodes in parts.items():
        for node in nodes:
            if node.component in _KINDS:
                found.setdefault((_KINDS[node.component], _label(node) + suffix), []).append(node)
    rows = [
        {
            "work": kind,
            "of": label,
            "runs": len(nodes),
            "hours": sum(n.record["seconds"] for n in nodes) / _HOUR,
            "minutes a run": sum(n.record["seconds"] for n in nodes) / len(nodes) / _MINUTE,
            "memory (GiB)": max(n.record.get("peak_rss_mib", 0.0) for n in nodes) / _GIB,
            "device": ", ".join(sorted({str(n.record.get("device", "unknown")) for n in nodes})),
        }
        for (kind, label), nodes in found.items()
    ]
    order = list(_KINDS.values())
    rows.sort(key=lambda row: (order.index(row["work"]), -row["hours"]))
    return pd.DataFrame(rows)


def _label(node: StoredNode) -> str:
    if node.component in ("evaluation", "judgement"):
        return node.name.split("/")[1]
    if node.component == "policy_training":
        return node.name.split("/")[0]
    return str(node.tags.get("model", "all logs"))


def software_table(nodes: Iterable[StoredNode]) -> pd.DataFrame:
    """A row per combination of software and computer, with the number of nodes made with it."""
    counted: Counter[tuple[tuple[str, str], ...]] = Counter()
    for node in nodes:
        software = {k: str(v) for k, v in node.record.get("software", {}).items()}
        said = {
            "computer": str(node.record.get("hardware", "unknown")),
            "this package": str(node.record.get("package", "unknown")),
            **{k: software.get(k, "") for k in ("torch", "numpy", "mujoco", "device", "float32")},
        }
        counted[tuple(said.items())] += 1
    return pd.DataFrame([{**dict(said), "nodes": n} for said, n in counted.most_common()])
