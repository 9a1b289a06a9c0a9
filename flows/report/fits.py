"""Notes on models whose fit ended early."""

from collections.abc import Iterable

from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore

__all__ = ["fit_notes"]


def fit_notes(done: Iterable[Node], store: ArtifactStore) -> list[str]:
    """A sentence for every model whose loss was no longer finite at some update of its fit.

    Args:
        done: Finished nodes of a sweep.
        store: With their artifacts.

    Raises:
        DamagedFileError: The metrics of a fit are missing or damaged.
    """
    notes = []
    for node in done:
        if node.component != "model_fitting":
            continue
        ended_at = store.read_json(node.key, "metrics.json").get("training/ended_at")
        if ended_at is not None:
            notes.append(
                f"{node.tags['model']} on {node.tags['dataset']}: its loss was no longer finite at "
                f"update {ended_at}; its state of lowest held-out loss is used."
            )
    return notes
