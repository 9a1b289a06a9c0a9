"""A store whose policies are all small, and some of them hostile."""

import dataclasses
import json
from pathlib import Path

from components.core.files import write_json
from components.data.dataset import OfflineDataset
from components.policies.policy import Policy
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord
from tests.components.operating.machines import LOG, TURBINE, dial
from tests.flows.pipeline.toys import record_of

LOG_KEY, TURBINE_LOG, OWN, HOSTILE, BROKEN, HUGE, ESCAPING, ODD = (
    letter * 32 for letter in "01abcdef"
)
HTML = "lion/<img src=x onerror=\"document.title='owned'\"><script>alert(1)</script>"


def finish(store: ArtifactStore, key: str, name: str, component: str, **inputs: str) -> Path:
    folder = store.path(key)
    folder.mkdir(parents=True)
    write_json(folder / "node.json", record_of(key, name=name, component=component, inputs=inputs))
    return folder


def add_policy(store: ArtifactStore, key: str, name: str, dataset: str) -> Path:
    folder = finish(store, key, name, "policy_training", dataset=dataset) / "policy"
    folder.mkdir()
    policy: Policy = dial()
    policy.save(folder)
    return folder


def hostile_store(root: Path) -> ArtifactStore:
    """Logs with and without a system, and policies that are fine, hostile, broken and huge."""
    store = ArtifactStore(root)
    own = dataclasses.replace(LOG, card=dataclasses.replace(LOG.card, name=HTML))
    own.write(finish(store, LOG_KEY, "data/own", "data_generation") / "dataset")
    turbine: OfflineDataset = dataclasses.replace(
        LOG, card=dataclasses.replace(TURBINE, digest=LOG.card.digest, steps=LOG.card.steps)
    )
    turbine.write(finish(store, TURBINE_LOG, "data/toy", "data_generation") / "dataset")
    add_policy(store, OWN, "lion/own/seed0", LOG_KEY)
    add_policy(store, HOSTILE, HTML, TURBINE_LOG)
    (add_policy(store, BROKEN, "lion/broken/seed0", LOG_KEY) / "policy.json").write_text("{")
    with (add_policy(store, HUGE, "lion/huge/seed0", LOG_KEY) / "policy.json").open("a") as file:
        file.write(" " * 2_000_000)
    add_policy(store, ESCAPING, "lion/escaping/seed0", "../../../../../../etc")
    odd = json.loads(
        (add_policy(store, ODD, "lion/" + "x" * 5000, LOG_KEY) / "policy.json").read_text()
    )
    odd["algorithm"] = ["not", "a", "name"]
    (store.path(ODD) / "policy" / "policy.json").write_text(json.dumps(odd))
    return store


def add_sweep(store: ArtifactStore) -> Plan:
    """A sweep of two cells, of which one is finished."""

    def node(component: str, name: str, algorithm: str, **inputs: Node) -> Node:
        return Node(
            component=component,
            name=name,
            task="tests.flows.pipeline.toys:number",
            version=1,
            config={"name": name},
            inputs=inputs,
            tags={"algorithm": algorithm, "dataset": "<b>toy</b>", "seed": "0"},
        )

    nodes = []
    for algorithm in ("bc", "lion"):
        policy = node("policy_training", f"{algorithm}/toy/seed0", algorithm)
        name = f"evaluate/{algorithm}/toy/seed0"
        nodes += [policy, node("evaluation", name, algorithm, policy=policy)]
    plan = Plan(nodes)
    SweepRecord.of("small", "python -m flows.full_benchmark", plan).save(store.root)
    for done in plan.nodes[:2]:
        folder = finish(store, done.key, done.name, done.component)
        record = json.loads((folder / "node.json").read_text())
        write_json(folder / "node.json", record | {"config": {"name": done.name}})
    import numpy as np

    np.savez(
        store.path(plan.nodes[1].key) / "curves.npz",
        **{"evaluation/return/step": np.arange(1, 4), "evaluation/return/value": np.arange(3.0)},
    )
    report = store.root / "reports" / "small"
    report.mkdir(parents=True)
    (report / "report.html").write_text("<title>the report</title>")
    (store.root / "reports" / "secret.txt").write_text("secret")
    return plan
