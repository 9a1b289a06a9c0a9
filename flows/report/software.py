"""Says if cells of a table come from different software or devices."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore

__all__ = ["software_notes"]

_COMPUTED = ("model_fitting", "policy_training", "evaluation")
"""Components whose numbers depend on software and device, to rounding at least."""


def software_notes(cells: Sequence[Node], store: ArtifactStore) -> list[str]:
    """A sentence if not all comes from the same software on the same kind of device.

    Records of older versions do not tell theirs. What is unknown throughout is not mixed.

    Args:
        cells: Aggregation nodes, one per cell of the table.
        store: With the records of what they read.
    """
    labels: dict[str, str] = {}  # by key, since cells share models
    made_with: Counter[tuple[str, ...]] = Counter()
    for cell in cells:
        for node in _behind(cell):
            if node.key not in labels:
                known = store.complete(node.key)  # a cell may outlive what it was made from
                labels[node.key] = _label(store.record(node.key) if known else {})
        made_with[tuple(sorted({labels[node.key] for node in _behind(cell)}))] += 1
    if len(set(labels.values())) < 2:
        return []
    shown = ", ".join(
        f"{' and '.join(names)} ({count} {'cell' if count == 1 else 'cells'})"
        for names, count in sorted(made_with.items(), key=lambda item: (-item[1], item[0]))
    )
    return [f"The cells come from different software or devices: {shown}."]


def _behind(node: Node) -> Iterator[Node]:
    """The nodes from which a cell is computed."""
    for source in node.inputs.values():
        if source.component in _COMPUTED:
            yield source
        yield from _behind(source)


def _label(record: Mapping[str, Any]) -> str:
    found = record.get("software")
    if not isinstance(found, dict) or "torch" not in found:
        return "unknown software"
    precision = found.get("float32", "highest")
    note = "" if precision == "highest" else f" in {precision} float32 precision"
    return f"torch {found['torch']} on {found.get('device', 'an unknown device')}{note}"
