"""What a GPU must do as a processor does: the same draws, the same learning; and graphs of it.

Every check is a row per learner that says "ok" or what failed. On a processor recorded operations
stand for graphs.
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from benchmarks import learner_paths
from benchmarks.records import Row
from benchmarks.settings import Settings
from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import LearnerInputs, PolicyLearner
from components.core.random_streams import lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.training.cuda_graphs import CudaGraphs, GraphedLearner, lost_graphs
from components.training.loop import TrainingLoop
from components.training.recorded import RecordedGraphs
from components.training.sums import MetricSums
from flows.pipeline.computer import set_precision

__all__ = [
    "FAILED",
    "captures",
    "draws",
    "models_of",
    "small_settings",
    "stack",
    "twins",
    "with_graphs",
]

FAILED = "FAILED: "
_TWIN_UPDATES = 100
_FOLLOWS = 0.05
"""Allowed distance of twins, as a share of the way that the networks have gone.

Rounding differs by 1e-7 at every update. Adam's first steps have the length of the learning rate
whatever the gradient's, so an entry whose gradient is about zero may go either way; natural
gradients, see MOReL, turn a rounding into another step and are not held to it.
"""
_NOT_HELD = ("morel",)
_SMALL: Mapping[str, Any] = MappingProxyType(  # where a configuration has such a field
    {
        "hidden": (32, 32),
        "vae_hidden": (32,),
        "critic_hidden": (32,),
        "value_hidden": (32,),
        "batch": 64,
        "updates": 400,
        "trajectories": 6,
        "horizon": 5,
        "target_actions": 3,
        "tried_actions": 3,
        "rollouts": 50,
        "rollout_every": 40,
        "window": 20,
        "particles": 9,
        "neighbourhood": 3,
        "starts": 6,
        "fisher_samples": 100,
    }
)
_SMALLER: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {"morel": {"cloning": 40}, "brac": {"cloning": 0.1}}
)


def small_settings(name: str, quick: bool) -> dict[str, Any]:
    """Settings with which a learner is small, and smaller still if it is quick."""
    fields = {field.name for field in dataclasses.fields(ALGORITHMS[name].config)}
    found = {key: value for key, value in _SMALL.items() if key in fields}
    found |= {"hidden": (8,), "batch": 16} if quick and "batch" in fields else {}
    return found | dict(_SMALLER.get(name, {}))


def models_of(names: Sequence[str], dataset: OfflineDataset) -> dict[str, object]:
    """The models that learners need, barely fitted, by name."""
    needed = {model for name in names for model in ALGORITHMS[name].needs}
    return {model: learner_paths.barely_fitted(model, dataset) for model in sorted(needed)}


def stack(
    name: str,
    dataset: OfflineDataset,
    models: Mapping[str, object],
    lanes: int,
    device: torch.device,
    **changes: object,
) -> Any:
    """A learner of equal lanes but for their seeds."""
    record = ALGORITHMS[name]
    inputs = LearnerInputs(
        data=LaneData([dataset] * lanes, device, record.frame_epsilon),
        keys=[lane_key(dataset.card.name, name, seed) for seed in range(lanes)],
        models={model: [models[model]] * lanes for model in record.needs},
    )
    return record.learner(record.config(**changes), inputs)


def with_graphs(learner: PolicyLearner, settings: Settings) -> GraphedLearner:
    """A learner whose updates are graphs."""
    place = settings.place
    return GraphedLearner(learner, CudaGraphs(place) if settings.on_a_gpu else RecordedGraphs())


def _names(settings: Settings) -> list[str]:
    return ["td3_bc", "lion"] if settings.quick else list(ALGORITHMS)


def _checked(unit: str, name: str, wrong: str, **found: Any) -> Row:
    return Row(unit=unit, name=name, note=f"{FAILED}{wrong}" if wrong else "ok", **found)


def draws(settings: Settings) -> Iterator[Row]:
    """A row per learner: largest difference of what both devices draw."""
    dataset = dataclasses.replace(settings, quick=True).dataset()
    models = models_of(_names(settings), dataset)
    for name in _names(settings):
        here, there = (
            stack(name, dataset, models, 2, device, **small_settings(name, settings.quick))
            for device in (torch.device("cpu"), settings.place)
        )
        wrong, largest = "", 0.0
        for step in (here.pretraining, here.pretraining + 7):
            there.stage(step, 1)
            there.draw(step, 1)
            of_policy = step - (here.pretraining if name == "morel" else 0)
            expected, found = (made._streams.at(of_policy) for made in (here, there))
            for draw, numbers in expected.items():
                other = found[draw].cpu()
                if numbers.is_floating_point():
                    apart = float((numbers - other).abs().max())
                    largest = max(largest, apart)
                    same = torch.allclose(numbers, other, rtol=1e-4, atol=1e-5)
                else:
                    same = torch.equal(numbers, other)
                wrong = wrong or ("" if same else f"{draw} at step {step} differs")
        yield _checked("draws", name, wrong, value=largest, measure="largest difference")


def twins(settings: Settings) -> Iterator[Row]:
    """A row per learner: how far it is from its twin after 100 updates, both in full precision."""
    set_precision(settings.place.type, "highest")
    dataset = dataclasses.replace(settings, quick=True).dataset()
    models, updates = models_of(_names(settings), dataset), 40 if settings.quick else _TWIN_UPDATES
    loop = TrainingLoop(updates, ["a", "b"], log_every=20)
    for name in _names(settings):
        small = small_settings(name, settings.quick)
        plain = stack(name, dataset, models, 2, torch.device("cpu"), **small)
        start = {key: tensor.clone() for key, tensor in _weights(plain).items()}
        made = stack(name, dataset, models, 2, settings.place, **small)
        graphs = with_graphs(made, settings)
        with lost_graphs() as lost:
            loop.run(plain)
            loop.run(graphs, at=())
        way, apart = 0.0, 0.0
        found = _weights(made)
        for key, tensor in _weights(plain).items():
            if key not in start:
                continue
            way += float((tensor - start[key]).square().sum())
            apart += float((tensor - found[key].cpu()).square().sum())
        share = (apart / way) ** 0.5 if way else float("nan")
        wrong = "; ".join(lost)
        if not share <= _FOLLOWS and name not in _NOT_HELD:
            wrong = f"{wrong}; further than {_FOLLOWS:.0%}".removeprefix("; ")
        measure = f"of the way, after {updates} updates"
        yield _checked("twins", name, wrong, value=share, measure=measure)


def _weights(learner: Any) -> dict[str, Tensor]:
    """What the networks have learned, where it is finite.

    What was rolled out or measured with them is none of it.
    """
    return {
        f"{name}.{key}": tensor
        for name, network in learner._networks.items()
        if name not in ("buffer", "detector")
        for key, tensor in network.state_dict().items()
        if tensor.is_floating_point() and tensor.isfinite().all()
    }


def captures(settings: Settings) -> Iterator[Row]:
    """A row per learner of the usual size: captured, in a process that has captured the others."""
    dataset = settings.dataset()
    models = models_of(_names(settings), dataclasses.replace(settings, quick=True).dataset())
    for name in _names(settings):
        usual = {"rollouts": 2000} if name == "mopo" else {}
        changes = small_settings(name, True) if settings.quick else usual
        made = stack(name, dataset, models, settings.lanes[0], settings.place, **changes)
        graphs, sums = with_graphs(made, settings), MetricSums()
        first = made.pretraining
        begin = time.perf_counter()
        if name == "mopo":
            graphs.run_updates(0, 1, sums)
            first = 1
        with lost_graphs() as lost:
            # warm-up, capture and one replay
            graphs.run_updates(first, 3 * max(made.updates_per_graph, 2), sums)
        settings.settle()
        wrong = "; ".join(lost) or ("" if graphs.captured else "no graph")
        taken = time.perf_counter() - begin
        yield _checked("captures", name, wrong, value=taken, measure="s")
