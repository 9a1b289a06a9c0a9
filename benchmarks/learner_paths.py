"""Updates of every learner, and of the peers that have the same: d3rlpy and plain JAX.

Rates are seed-updates per second, updates times lanes, so that five lanes can be held against five
seeds in turn. Random numbers are drawn in blocks of steps: a fast learner is timed over whole
blocks; of a slow one, ordinary steps are timed and the surplus of a step that begins a block is
spread over the block. Warm-ups of the algorithm are skipped by starting in the middle of the
budget; MOPO is timed between roll-outs, which are few and made once here, with a small buffer.
"""

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from statistics import mean
from types import MappingProxyType

import torch

from benchmarks.floors import Work, work_of_updates
from benchmarks.lanes import UNTRAINED
from benchmarks.model_free import peer_command, run, write_transitions
from benchmarks.records import Row, row_of_seconds
from benchmarks.settings import Settings
from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import LearnerInputs, PolicyLearner
from components.core.random_streams import BLOCK, lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.models import MODELS
from components.training.cuda_graphs import graphed
from components.training.loop import RunLearner
from components.training.sums import MetricSums

__all__ = ["IN_JAX", "RATES", "beside_d3rlpy", "beside_jax", "jax_command", "updates"]

_OVERRIDES: Mapping[str, Mapping[str, object]] = MappingProxyType({"mopo": {"rollouts": 2000}})
RATES: Mapping[str, Mapping[str, int]] = MappingProxyType(
    {"mopo": {"rollouts": 1}, "morel": {"cloning": 0}}
)
"""Settings under which a plan's cost is that of the updates timed here, and of one lane."""
_QUICK: Mapping[str, int] = MappingProxyType(
    {"trajectories": 5, "starts": 5, "horizon": 5, "rollouts": 50, "fisher_samples": 50}
)
"""Sizes of virtual trajectories in quick runs, whose numbers mean nothing."""
_NOTES = MappingProxyType({"mopo": "between roll-outs", "wsbc": "an update is an iteration"})
_ALTERNATING = ("td3_bc", "lambda_td3_bc")  # every second of whose updates has no actor
_PEER_UPDATES = MappingProxyType(  # d3rlpy's per timing, about a second
    {"ddpg": 80, "bcq": 25, "bear": 18, "cql": 8, "td3_bc": 80}
)
IN_JAX = MappingProxyType({"td3_bc": (1, 5), "cql": (5,)})
"""What peer_jax.py has, with the numbers of lanes that a CPU is asked for by default."""

_SLOW, _SLOW_REPEATS = 5.0, 2  # seconds of an update from which on fewer are timed
MEASURE = "seed-updates/s"


def barely_fitted(name: str, dataset: OfflineDataset) -> object:
    """A model of the usual sizes whose weights do not matter."""
    if name in UNTRAINED:
        return UNTRAINED[name](dataset)
    kind, key = MODELS[name], lane_key("benchmark", name)
    return kind.fit(dataset, kind.config(epochs=1), key, torch.device("cpu"), None).model


def _learner(
    algorithm: str,
    dataset: OfflineDataset,
    models: Mapping[str, object],
    lanes: int,
    device: torch.device,
    quick: bool,
) -> PolicyLearner:
    record = ALGORITHMS[algorithm]
    changed = dict(_OVERRIDES.get(algorithm, {}))
    if quick:
        known = {item.name for item in fields(record.config)}
        changed |= {name: value for name, value in _QUICK.items() if name in known}
    inputs = LearnerInputs(
        data=LaneData([dataset] * lanes, device, record.frame_epsilon),
        keys=[lane_key(dataset.card.name, algorithm, seed) for seed in range(lanes)],
        models={name: [model] * lanes for name, model in models.items()},
    )
    return record.learner(record.config(**changed), inputs)


def _first_step(algorithm: str, learner: PolicyLearner) -> int:
    """A step that begins a block of random numbers, past all warm-ups."""
    if algorithm == "mopo":
        return 2 * BLOCK
    middle = ALGORITHMS[algorithm].config().updates // 2
    return learner.pretraining + (middle // BLOCK + 1) * BLOCK


def seconds_per_update(
    update: Callable[[int], object], first: int, settings: Settings
) -> list[float]:
    """Seconds of an update in every repeat, draws included.

    Args:
        update: Called with the number of a step.
        first: Its first, which begins a block.
        settings: Of the measurement.
    """
    beginning = settings.once(lambda: update(first))
    if beginning > _SLOW:
        ordinary = [settings.once(lambda i=i: update(first + 1 + i)) for i in range(_SLOW_REPEATS)]
        surplus = max(beginning - mean(ordinary), 0.0) / BLOCK
        return [seconds + surplus for seconds in ordinary]
    usual = mean(settings.once(lambda step=first + i: update(step)) for i in (1, 2))
    share = settings.seconds / settings.repetitions
    if usual * BLOCK <= 2 * share:
        blocks, step = max(1, round(share / (usual * BLOCK))), first

        def some() -> None:
            nonlocal step
            for _ in range(blocks * BLOCK):
                step += 1
                update(step)

        return [settings.once(some) / (blocks * BLOCK) for _ in range(settings.repetitions)]
    surplus, step = max(beginning - usual, 0.0) / BLOCK, first + 2
    count = max(2 if usual < share else 1, int(share / usual))

    def few() -> None:
        nonlocal step
        for _ in range(count):
            step += 1
            update(step)

    return [settings.once(few) / count + surplus for _ in range(settings.repetitions)]


class Training:
    """Runs of updates one after the other, as the training loop asks for them on a GPU.

    Args:
        program: Does them by graphs.
        several: Updates of a graph.
        first: First update; rounded down to a multiple, as logging intervals begin.
    """

    def __init__(self, program: RunLearner, several: int, first: int) -> None:
        self.several, self._program, self._sums = several, program, MetricSums()
        self._step = first - first % several

    def advance(self, count: int) -> None:
        """Do some more updates."""
        self._program.run_updates(self._step, count, self._sums)
        self._step += count

    def timings(self, settings: Settings) -> list[float]:
        """Seconds of an update in every repeat, after warm-up and capture."""
        self.advance(3 * max(self.several, 2))
        seconds = settings.once(partial(self.advance, self.several)) / self.several
        fitting = settings.seconds / settings.repetitions / seconds / self.several
        count = self.several * (1 if settings.quick else max(1, round(fitting)))
        return [
            settings.once(partial(self.advance, count)) / count for _ in range(settings.repetitions)
        ]


def _work(
    algorithm: str, dataset: OfflineDataset, models: Mapping[str, object], quick: bool
) -> Work:
    learner = _learner(algorithm, dataset, models, 1, torch.device("cpu"), quick)
    first = _first_step(algorithm, learner)
    if algorithm == "mopo":
        learner.update(0)
    learner.update(first)  # optimisers make their moments
    steps = (first + 1, first + 2) if algorithm in _ALTERNATING else (first + 1,)
    return work_of_updates(learner, steps)


def updates(algorithm: str, settings: Settings) -> Iterator[Row]:
    """Rows of our learner, one per number of lanes."""
    dataset = settings.dataset()
    small = Settings(quick=True).dataset()
    models = {name: barely_fitted(name, small) for name in ALGORITHMS[algorithm].needs}
    work, unit, expected = (
        _work(algorithm, dataset, models, settings.quick),
        f"learner {algorithm}",
        0.0,
    )
    for lanes in settings.lanes:
        name = f"{algorithm}, {lanes} lane(s)"
        whole = lanes * expected * (1 + _SLOW_REPEATS)
        allowed = settings.longest * (2 if lanes <= 5 else 1)
        if whole > allowed and not settings.everything:
            note = f"left out: an update would take {lanes * expected:.1f} s; --all measures it"
            yield Row(unit=unit, name=name, note=note)
            continue
        learner = _learner(algorithm, dataset, models, lanes, settings.place, settings.quick)
        program = graphed(learner, settings.place)
        first = _first_step(algorithm, learner)
        if algorithm == "mopo":
            program.update(0)
        if isinstance(program, RunLearner):
            timings = Training(program, learner.updates_per_graph, first).timings(settings)
        else:
            for step in range(first - int(expected * lanes < 1), first):
                program.update(step)
            timings = seconds_per_update(program.update, first, settings)
        expected = min(timings) / lanes if not settings.on_a_gpu else 0.0
        floor, bound = work.floor(settings.limits, lanes)
        yield row_of_seconds(
            unit,
            name,
            timings,
            amount=float(lanes),
            measure=MEASURE,
            floor=floor,
            bound=bound,
            note=_NOTES.get(algorithm, ""),
            rate=settings.rate(
                "policy_training",
                algorithm,
                lanes=lanes,
                settings={"updates": 1, **RATES.get(algorithm, {})},
            ),
        )


def beside_d3rlpy(algorithm: str, settings: Settings) -> Iterator[Row]:
    """Rows of d3rlpy's counterpart, on the CPU: one seed, and as many in turn as we have lanes."""
    unit, count = f"learner {algorithm}", 3 if settings.quick else _PEER_UPDATES[algorithm]
    dataset = settings.dataset()
    with tempfile.TemporaryDirectory() as folder:
        arrays = Path(folder) / "transitions.npz"
        write_transitions(dataset, ALGORITHMS[algorithm].frame_epsilon, arrays)
        command = peer_command(settings.peer_python(), arrays, algorithm, count, settings.threads)
        command += ["--repetitions", str(settings.repetitions)]
        answer = run(command, settings.threads)
    timings = [seconds / count for seconds in answer["timings"]]
    for lanes in settings.lanes[:2]:
        note = "one seed" if lanes == 1 else "seeds in turn: the rate of one"
        name = f"{algorithm}, {lanes} lane(s)"
        peer = answer["program"]
        yield row_of_seconds(unit, name, timings, amount=1.0, measure=MEASURE, peer=peer, note=note)


def jax_command(python: Path, data: Path, algorithm: str, *options: str) -> list[str]:
    """The command that runs JAX's counterpart with our default settings."""
    wanted = {"algorithm": algorithm, **asdict(ALGORITHMS[algorithm].config())}
    script = Path(__file__).with_name("peer_jax.py")
    return [str(python), "-I", str(script), str(data), json.dumps(wanted), *options]


def beside_jax(algorithm: str, settings: Settings) -> Iterator[Row]:
    """Rows of JAX's counterpart on the same device, one per number of lanes."""
    lanes_of: Sequence[int] = settings.lanes
    if not settings.on_a_gpu and not settings.everything and not settings.quick:
        lanes_of = IN_JAX[algorithm]
    dataset = settings.dataset()
    with tempfile.TemporaryDirectory() as folder:
        arrays = Path(folder) / "transitions.npz"
        write_transitions(dataset, ALGORITHMS[algorithm].frame_epsilon, arrays)
        for lanes in lanes_of:
            options = {
                "--lanes": lanes,
                "--threads": settings.threads,
                "--seconds": settings.seconds,
                "--repetitions": settings.repetitions,
                "--device": settings.place.type,
            }
            words = [str(word) for pair in options.items() for word in pair]
            command = jax_command(settings.peer_python(), arrays, algorithm, *words)
            answer = run(command, settings.threads)
            timings = [seconds / answer["updates"] for seconds in answer["timings"]]
            yield row_of_seconds(
                f"learner {algorithm}",
                f"{algorithm}, {lanes} lane(s)",
                timings,
                amount=float(lanes),
                measure=MEASURE,
                peer=answer["program"],
                note=f"compiled in {answer['compile_seconds']:.0f} s",
            )
