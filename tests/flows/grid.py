"""Plans computed group by group in this process, without Ray and MLflow."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from components.core.files import read_json
from flows.pipeline.group import GroupCall
from flows.pipeline.plan import Plan
from flows.pipeline.schedule import form_groups
from flows.pipeline.store import ArtifactStore
from flows.pipeline.worker import run_group


def overridden(base: Sequence[str], words: Sequence[str]) -> list[str]:
    """Words of a command line, those of the base only where no other word gives their key."""
    keys = {word.partition("=")[0] for word in words}
    return [*(word for word in base if word.partition("=")[0] not in keys), *words]


def finished(plan: Plan, root: Path, device: str = "cpu") -> ArtifactStore:
    """The store in which all nodes of a plan are complete."""
    store = ArtifactStore(root)
    for group in form_groups(plan, [node.key for node in plan], store):
        result = run_group(GroupCall.of(group.name, store.root, group.nodes, device))
        assert not result.failed, "\n".join(result.failed.values())
    return store


def metrics(plan: Plan, store: ArtifactStore, component: str, algorithm: str | None = None) -> Any:
    """What the one such node of a finished plan has measured."""
    [node] = [
        node
        for node in plan
        if node.component == component and algorithm in (None, node.tags.get("algorithm"))
    ]
    return read_json(store.path(node.key) / "metrics.json")
