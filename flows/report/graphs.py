"""Notes on trainings that ran without the CUDA graphs they should have had."""

from collections.abc import Iterable

from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore

__all__ = ["graph_notes"]

_TRAINED = ("model_fitting", "policy_training")
_SHOWN = 3  # names in a sentence


def graph_notes(done: Iterable[Node], store: ArtifactStore) -> list[str]:
    """A sentence per reason: which trainings have lost graphs of their updates.

    Args:
        done: Finished nodes of a sweep.
        store: With their records.
    """
    lost: dict[str, list[str]] = {}
    for node in done:
        if node.component in _TRAINED:
            said = store.record(node.key).get("tags", {}).get("graphs", "")
            if said:
                lost.setdefault(said.removeprefix("lost: "), []).append(node.name)
    notes = []
    for reason, names in lost.items():
        others = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        notes.append(
            f"Trained without CUDA graphs, which may take ten times as long: "
            f"{', '.join(names[:_SHOWN])}{others} ({reason})."
        )
    return notes
