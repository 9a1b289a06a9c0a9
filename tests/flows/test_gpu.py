"""The whole grid on a GPU: every part gives there what it gives on the processor.

Random numbers do not depend on the device, so both train on the same draws. Skipped where there is
no GPU.
"""

import functools
from pathlib import Path
from typing import Any

import pytest
import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.training import train_policies
from components.core.tensors import load_tensors
from flows.configuration.settings import load_settings
from flows.pipeline.group import GroupCall
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.worker import run_group
from flows.planning.benchmark import benchmark_plan
from tests.components.interruption import KilledError, dying
from tests.flows.grid import finished

GPU = "cuda"
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no GPU"),
]

# The products of the two sum in another order; Adam turns a difference in a tiny gradient into one
# of the step's size, here at most 1e-3. As between stacked and single lanes on the processor.
CLOSE = {"rtol": 1e-2, "atol": 2e-3}


# MOReL's steps are natural gradients from few samples: conjugate gradients turn a rounding of 1e-7
# into 1e-3 within one step and another policy within eight, on a processor too. So it takes one,
# and damps it: that leaves 1e-6.
WORDS = [
    "profile=smoke", "training.snapshots=1", "algorithm.morel.updates=1",
    "algorithm.morel.damping=0.1",
]  # fmt: skip


@functools.cache
def plan() -> Plan:
    return benchmark_plan(load_settings(WORDS))


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[ArtifactStore, ...]:
    return tuple(
        finished(plan(), tmp_path_factory.mktemp(device), device) for device in ("cpu", GPU)
    )


def policies_of(algorithm: str) -> list[Node]:
    """One node per seed."""
    trained = [node for node in plan() if node.component == "policy_training"]
    return [node for node in trained if node.tags["algorithm"] == algorithm]


def same(node: Node, stores: tuple[ArtifactStore, ...], folder: str) -> None:
    """Compare all tensors that a node has stored."""
    files = [sorted((store.path(node.key) / folder).rglob("*.safetensors")) for store in stores]
    assert len(files[0]) == len(files[1]) > 0
    for here, there in zip(*files, strict=True):
        expected, found = load_tensors(here)[0], load_tensors(there)[0]
        assert found.keys() == expected.keys()
        for name, tensor in expected.items():
            torch.testing.assert_close(
                found[name], tensor, **CLOSE, msg=lambda text, n=name: f"{node.name} {n}: {text}"
            )


def test_models_are_the_processors(stores: tuple[ArtifactStore, ...]) -> None:
    for node in plan():
        if node.component == "model_fitting":
            same(node, stores, "model")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_policies_are_the_processors(algorithm: str, stores: tuple[ArtifactStore, ...]) -> None:
    for node in policies_of(algorithm):
        same(node, stores, "policy")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_killed_training_continues_there(
    algorithm: str,
    stores: tuple[ArtifactStore, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(train_policies.__kwdefaults__, "save_every", 0.0)  # at every update
    nodes = policies_of(algorithm)
    store = ArtifactStore(tmp_path)
    for source in {source.key for node in nodes for source in node.inputs.values()}:
        (store.nodes / source).symlink_to(stores[1].path(source))
    call = GroupCall.of("again", store.root, nodes, GPU)
    learner = ALGORITHMS[algorithm].learner
    with monkeypatch.context() as killing:
        killing.setattr(learner, "update", dying(learner.update, death=5))
        staged = learner.stage

        def stage(made: Any, first: int, count: int) -> None:
            if first <= 5 < first + count:  # a captured update is not called again, but staged
                raise KilledError
            staged(made, first, count)

        killing.setattr(learner, "stage", stage)
        assert len(run_group(call).failed) == len(nodes)
    assert not run_group(call).failed
    for node in nodes:
        assert store.record(node.key)["resumed"]
        same(node, (stores[1], store), "policy")
