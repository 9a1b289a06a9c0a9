"""The hot paths beside learners and pipeline: environments, fits, evaluation, loading."""

import itertools
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import torch

from benchmarks import environment, plain_peers, recurrent, robots, wsbc
from benchmarks.floors import Work, operations
from benchmarks.lanes import UNTRAINED
from benchmarks.records import Row, row_of_seconds
from benchmarks.scalar_industrial_benchmark import TunedScalarIndustrialBenchmark
from benchmarks.settings import Settings
from components.algorithms.wsbc import Config as SwarmConfig
from components.core.random_streams import lane_generator, lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification
from components.data.starts import start_rows
from components.environments.mujoco.specifications import ROBOTS, load_model
from components.evaluation.protocol import EvaluationProtocol
from components.evaluation.real import evaluate_policies
from components.models import MODELS
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from components.models.supervised import UNWATCHED
from components.networks import StackedMLP
from components.policies.policy import Policy

__all__ = [
    "dataset_load",
    "evaluation",
    "fit",
    "industrial",
    "recurrent_pass",
    "robot_rollouts",
    "swarm_peer",
]

_PASSES = 100  # updates of the recurrent ensemble's fit


def _draws(copies: int, steps: int) -> Callable[[], None]:
    """The six numbers a step of a copy needs, drawn by NumPy's fastest generator and not used."""
    rng = np.random.Generator(np.random.SFC64(0))
    out = np.empty((steps, 2, copies))

    def run() -> None:
        rng.standard_exponential(out=out)
        rng.random(out=out)
        rng.standard_normal(out=out)

    return run


def industrial(settings: Settings) -> Iterator[Row]:
    """Steps of the Industrial Benchmark, beside a scalar loop tuned with `math`."""
    unit, measure = "Industrial Benchmark", "steps/s"
    for copies in (1, 100) if settings.quick else (1, 100, 1000, 10_000):
        run, name = environment.vectorised(copies), f"{copies:,} copies"
        steps = run()
        draw = min(settings.timings(_draws(copies, steps // copies)))
        bound = "its draws alone, one core"
        timings = settings.timings(run)
        yield row_of_seconds(
            unit, name, timings, amount=steps, measure=measure, floor=draw, bound=bound
        )
    loop = environment.scalar_loop(TunedScalarIndustrialBenchmark)
    steps = loop()
    timings = settings.timings(loop)
    yield row_of_seconds(
        unit, "1 copies", timings, amount=steps, measure=measure, peer="tuned scalar loop"
    )
    yield row_of_seconds(
        unit,
        "100 copies" if settings.quick else "1,000 copies",
        timings,
        amount=steps,
        measure=measure,
        peer="tuned scalar loop",
        note="one copy at a time",
    )


def _physics(robot: str) -> Callable[[], int]:
    """MuJoCo's own steps with nothing around them; their number in environment steps."""
    model = load_model(ROBOTS[robot], "v3")
    data, controls = mujoco.MjData(model), lane_generator(0).uniform(-1.0, 1.0, (100, model.nu))

    def run() -> int:
        mujoco.mj_resetData(model, data)
        for control in controls:
            data.ctrl[:] = control
            mujoco.mj_step(model, data, ROBOTS[robot].substeps)
        return len(controls)

    return run


def robot_rollouts(settings: Settings) -> Iterator[Row]:
    """Evaluations on the robots, beside a Python loop over one Gymnasium environment."""
    copies, episodes = (3, 1) if settings.quick else (1000, 5)
    for robot, record in itertools.islice(ROBOTS.items(), 1 if settings.quick else None):
        physics = _physics(robot)
        steps = physics()
        alone = min(settings.timings(physics)) / steps
        protocol = EvaluationProtocol(trajectories=copies)
        policy = robots.untrained_policy(record.id)
        count = robots._steps(policy, record.id, protocol)
        ours = partial(robots.evaluated, policy, record.id, protocol, settings.threads)
        yield row_of_seconds(
            "MuJoCo roll-outs",
            f"{robot}, {copies} copies",
            settings.timings(ours, warm=True),
            amount=count,
            measure="steps/s",
            floor=alone * count / settings.threads,
            bound=f"MuJoCo's steps alone, {settings.threads} thread(s)",
        )
        plain = partial(robots.plain_returns, policy, record.id, episodes, protocol)
        _, steps = plain()
        yield row_of_seconds(
            "MuJoCo roll-outs",
            f"{robot}, {copies} copies",
            settings.timings(plain, warm=True),
            amount=steps,
            measure="steps/s",
            peer="loop over one Gymnasium environment",
        )


def fit(kind: str, settings: Settings) -> Iterator[Row]:
    """A short fit of a supervised model at its default sizes."""
    dataset, model = settings.dataset(), MODELS[kind]
    if kind == "recurrent_ensemble":
        passes = 1 if settings.quick else _PASSES
        config, name = model.config(updates=passes, validate_every=passes), f"{passes} updates"
        budget = "updates"
    else:
        config, name, budget = model.config(epochs=1), "an epoch", "epochs"

    def run(device: torch.device = settings.place) -> None:
        key = lane_key(dataset.card.name, kind, 0)
        model.fit(dataset, config, key, device, None, UNWATCHED)

    work = Work(operations(lambda: run(torch.device("cpu"))))
    floor, bound = work.floor(settings.limits)
    yield row_of_seconds(
        "fits of supervised models",
        f"{kind}, {name} of {dataset.transitions:,} transitions",
        settings.timings(run, warm=not settings.on_a_gpu),
        floor=floor,
        bound=bound,
        note="with its validation",
        rate=settings.rate(
            "model_fitting",
            kind,
            lanes=1,
            settings={budget: getattr(config, budget)},
            transitions=dataset.transitions,
        ),
    )
    if kind == "behaviour_policy" and not settings.on_a_gpu:
        yield row_of_seconds(
            "fits of supervised models",
            f"{kind}, {name} of {dataset.transitions:,} transitions",
            settings.timings(plain_peers.clone_epoch(dataset, config)),
            peer="plain PyTorch loop",
            note="without its validation, observations made beforehand",
        )


def recurrent_pass(settings: Settings) -> Iterator[Row]:
    """A training pass of the recurrent ensemble, beside a plain loop over networks and steps."""
    sizes = RecurrentEnsembleConfig()
    if settings.quick:
        sizes = RecurrentEnsembleConfig(members=2, hidden=5, warm_up=4, horizon=6, batch=7)
    cpu = torch.device("cpu")
    weight, readout, windows, targets = recurrent.random_problem(sizes, settings.place)
    networks = recurrent.plain_networks(weight, readout)
    batch_major = [part.transpose(1, 2).contiguous() for part in windows.unbind(dim=1)]
    problem = [part.to(cpu) for part in (weight, readout, windows, targets)]
    for part in (*problem[:2], weight, readout):
        part.requires_grad_()
    floor, bound = Work(operations(lambda: recurrent.stacked_pass(*problem, sizes))).floor(
        settings.limits
    )
    unit = "recurrent ensemble, a training pass"
    name = f"{len(networks)} networks, {sizes.batch} windows"
    ours = partial(recurrent.stacked_pass, weight, readout, windows, targets, sizes)
    yield row_of_seconds(unit, name, settings.timings(ours), measure="ms", floor=floor, bound=bound)
    plain = partial(recurrent.plain_pass, networks, batch_major, targets, sizes.warm_up)
    yield row_of_seconds(
        unit, name, settings.timings(plain), measure="ms", peer="plain PyTorch loop"
    )


def swarm_peer(settings: Settings) -> Iterator[Row]:
    """WSBC's iteration one particle at a time; ours is in the rows of the learner."""
    dataset, config = settings.dataset(), SwarmConfig()
    if settings.quick:
        config = replace(config, starts=4, horizon=5)
    policy = UNTRAINED["behaviour_policy"](dataset)
    ensemble = UNTRAINED["recurrent_ensemble"](dataset)
    rows = start_rows(dataset, config.start_window)[: config.starts]
    data = LaneData([dataset], settings.place)
    [start] = data.raw_histories(torch.from_numpy(rows).to(settings.place)[None])
    rule = DynamicsSpecification.of_card(dataset.card)
    arguments = policy, ensemble, rule, start, config.horizon, config.discount
    timings = settings.timings(lambda: wsbc.plain_return(*arguments))
    yield row_of_seconds(
        "learner wsbc",
        "wsbc, 1 lane(s)",
        [config.particles * seconds for seconds in timings],
        amount=1.0,
        measure="seed-updates/s",
        peer="plain PyTorch loop",
        note=f"one particle timed, times {config.particles}",
    )


def evaluation(settings: Settings) -> Iterator[Row]:
    """Evaluation of 100 snapshots of a plain policy on the Industrial Benchmark."""
    dataset, count = settings.dataset(), 3 if settings.quick else 100
    card = dataset.card
    behaviour = UNTRAINED["behaviour_policy"](dataset)
    widths = (card.history * dataset.frames.shape[1], 256, 256, dataset.actions.shape[1])
    network = StackedMLP([lane_generator(i) for i in range(count)], widths)
    shape = replace(behaviour.card, steps=tuple(range(count)))
    policy = Policy.of_networks(
        shape,
        {"actor": network.affine()},
        LaneData([dataset] * count, settings.place).frame_scaling,
    )
    protocol = EvaluationProtocol()

    def run(device: torch.device = settings.place) -> None:
        evaluate_policies(
            [policy],
            [behaviour],
            card.environment,
            card.environment_parameters,
            protocol,
            card.discount,
            [0],
            device,
            threads=settings.threads,
        )

    floor, bound = Work(operations(lambda: run(torch.device("cpu")))).floor(settings.limits)
    states = protocol.trajectories * protocol.horizon
    name = f"{count} snapshots, {states:,} states each"
    yield row_of_seconds(
        "evaluation",
        name,
        settings.timings(run, warm=True),
        floor=floor,
        bound=bound,
        note="actor 256-256",
        rate=settings.rate("evaluation", "td3_bc", lanes=1, states=count * states),
    )
    times = count * protocol.trajectories
    plain = plain_peers.evaluation_loop(
        card.environment, dict(card.environment_parameters), widths[1:-1], protocol.horizon
    )
    yield row_of_seconds(
        "evaluation",
        name,
        [times * seconds for seconds in settings.timings(plain)],
        peer="loop over one Gymnasium environment",
        note=f"one trajectory timed, times {times:,}",
    )


def dataset_load(settings: Settings) -> Iterator[Row]:
    """Opening a stored dataset and making its tables, beside reading its files."""
    dataset = settings.dataset()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "dataset"
        dataset.write(place)
        files = [path for path in place.rglob("*") if path.is_file()]
        floor = min(settings.timings(lambda: [path.read_bytes() for path in files]))
        name = f"{dataset.transitions:,} transitions, warm file cache"
        for what, run in (
            ("opened", lambda: OfflineDataset.open(place)),
            (
                "opened, tables on the device",
                lambda: LaneData([OfflineDataset.open(place)], settings.place),
            ),
        ):
            yield row_of_seconds(
                "dataset load",
                f"{what}: {name}",
                settings.timings(run),
                measure="ms",
                floor=floor,
                bound="reading its files",
            )
