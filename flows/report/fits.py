"""Notes on models whose fit ended early or was in vain."""

from collections.abc import Iterable

from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore

__all__ = ["fit_notes"]


def fit_notes(done: Iterable[Node], store: ArtifactStore) -> list[str]:
    """Sentences on models whose loss was no longer finite at some update, or never fell.

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
        metrics = store.read_json(node.key, "metrics.json")
        model = f"{node.tags['model']} on {node.tags['dataset']}"
        if (ended_at := metrics.get("training/ended_at")) is not None:
            notes.append(
                f"{model}: its loss was no longer finite at update {ended_at}; its state of lowest "
                "held-out loss is used."
            )
        if (untrained := metrics.get("training/untrained_loss")) is not None:
            notes.append(
                f"{model}: the fit has learned nothing, as its held-out loss never fell below the "
                f"{untrained:.3g} of the untrained networks; lower its learning rate."
            )
    return notes
