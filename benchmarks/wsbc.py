"""Speed of a batched swarm: an iteration of WSBC against its particles one at a time.

`python -m benchmarks.wsbc [--device cpu] [--threads 2] [--repetitions 3]`, at the thesis's sizes.
The plain loop is how the fitness of one policy is commonly written in PyTorch: its trajectories are
one batch, but every network of the ensemble is called on its own, histories are joined anew at
every step and the recorded frames before the start are run through again. Some particles are timed
and the time of the iteration is computed from them. Both compute the same returns; the tests
compare the two.
"""

import argparse
import itertools
from collections.abc import Callable, Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from benchmarks.lanes import UNTRAINED, program
from benchmarks.measure import computer, markdown, median_seconds
from components.algorithms.wsbc import Config
from components.data.batches import LaneData
from components.data.dynamics import DynamicsSpecification
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.data.starts import start_rows
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.policies.policy import Policy
from components.training.loop import Learner
from components.training.memory import keep_freed_memory

__all__ = ["plain_return", "report"]

_DEFAULTS: Mapping[str, object] = MappingProxyType({})
_SWARMS = MappingProxyType({"swarm, 1 lane": 1, "swarm, 5 lanes": 5})
_PLAIN = "plain loop, one particle at a time"
_TIMED = 5  # particles of the plain loop


@torch.no_grad()
def plain_return(
    policy: Policy,
    ensemble: RecurrentEnsemble,
    rule: DynamicsSpecification,
    start: Tensor,
    horizon: int,
    discount: float,
) -> Tensor:
    """Mean virtual return of one policy, one network and one step at a time.

    Args:
        policy: A single one.
        ensemble: Its transition ensemble.
        rule: The known dynamics of the machine.
        start: `[S, H, F]` raw frames of the start states, newest first.
        horizon: Steps.
        discount: gamma.
    """
    width, count, device = ensemble.weight.shape[1], len(rule.known), start.device
    cells = [
        (w[:, :width].T, w[:, width:-1].T, w[:, -1], r[:, :-1].T, r[:, -1])
        for w, r in zip(ensemble.weight.to(device), ensemble.readout.to(device), strict=True)
    ]
    frames, policy = ensemble.frames.to(device), policy.to(device)
    low, high = ensemble.low.to(device), ensemble.high.to(device)
    moves, weights = (torch.tensor(t, device=device) for t in (rule.scale, rule.reward))
    hidden = [start.new_zeros(len(start), width) for _ in cells]

    def advance(inputs: Tensor, own: Tensor) -> list[Tensor]:
        predicted = []
        for n, (recurrent, given, bias, readout, offset) in enumerate(cells):
            fed = own if n < ensemble.members else torch.zeros_like(own)
            x = torch.cat([inputs, fed], dim=1)
            hidden[n] = torch.tanh(hidden[n] @ recurrent + x @ given + bias)
            predicted.append(hidden[n] @ readout + offset)
        return predicted

    recorded = frames.apply(start).flip(1).unbind(dim=1)  # oldest first
    for before, after in itertools.pairwise(recorded):
        advance(after[:, :count], before[:, count : count + 1])
    own = recorded[-1][:, count : count + 1]
    history, total = start, start.new_zeros(len(start))
    for step in range(horizon):
        x = policy.frames.apply(history).flatten(1)
        for weight, bias in policy.layers[:-1]:
            x = torch.relu(x @ weight[0] + bias[0])
        weight, bias = policy.layers[-1]
        action = torch.tanh(x @ weight[0] + bias[0])
        steering = (history[:, 0, 1:count] + action * moves).clamp(rule.low, rule.high)
        inputs = torch.cat([history[:, 0, :1], steering], dim=1)
        predicted = advance((inputs - frames.mean[:count]) / frames.scale[:count], own)
        fatigue = torch.cat(predicted[: ensemble.members], dim=1)
        consumption = torch.cat(predicted[ensemble.members :], dim=1)
        outputs = torch.stack([fatigue, consumption], dim=2).clamp(low, high)  # [S, K, D]
        raw = outputs * frames.scale[count:] + frames.mean[count:]
        reward, member = (raw * weights).sum(dim=2).min(dim=1)
        rows = torch.arange(len(start), device=device)
        own = outputs[rows, member, :1]
        frame = torch.cat([inputs, raw[rows, member]], dim=1)
        history = torch.cat([frame[:, None], history[:, :-1]], dim=1)
        total = total + discount**step * reward
    return total.mean()


def _iterations(learner: Learner) -> Callable[[], None]:
    """A runner of one further iteration."""
    done = 0

    def run() -> None:
        nonlocal done
        learner.update(done)
        done += 1

    return run


def report(
    device: str = "cpu",
    repetitions: int = 3,
    trajectories: int = 20,
    settings: Mapping[str, object] = _DEFAULTS,
) -> str:
    """Measure both; a Markdown table.

    Args:
        device: Where to compute.
        repetitions: Timings per row, the median counts.
        trajectories: Of the dataset, 1,000 steps each.
        settings: Differences from WSBC's default configuration.
    """
    keep_freed_memory()
    place, config = torch.device(device), Config(**settings)
    dataset = generate(
        IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=trajectories), seed=0
    )
    policy = UNTRAINED["behaviour_policy"](dataset)
    ensemble = UNTRAINED["recurrent_ensemble"](dataset)
    rule, data = DynamicsSpecification.of_card(dataset.card), LaneData([dataset], place)
    rows = start_rows(dataset, config.start_window)[: config.starts]
    [start] = data.raw_histories(torch.from_numpy(rows).to(place)[None])
    timed = min(_TIMED, config.particles)

    def plain() -> None:
        for _ in range(timed):
            plain_return(policy, ensemble, rule, start, config.horizon, config.discount)

    runs = {_PLAIN: plain} | {
        name: _iterations(program("wsbc", dataset, range(lanes), place, **settings))
        for name, lanes in _SWARMS.items()
    }
    seconds = median_seconds(runs, repetitions)
    seconds[_PLAIN] *= config.particles / timed
    table = []
    for name, whole in seconds.items():
        minutes = whole * config.updates / 60.0
        ratio = seconds[_PLAIN] * _SWARMS.get(name, 1) / whole
        table.append([name, f"{whole:,.2f}", f"{minutes:,.1f}", f"{ratio:.1f}"])
    columns = ["iteration", "s", f"minutes for {config.updates}", "times faster per lane"]
    return markdown(columns, table) + (
        f"\n\n{config.particles} particles, {len(rows)} start states, {config.horizon} steps, "
        f"{ensemble.members} pairs of networks, float32. Minutes are computed from iterations, "
        f"and those of the plain loop from {timed} particles."
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wsbc", description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(report(options.device, options.repetitions))
    print(f"\n{computer(options.device)}")


if __name__ == "__main__":
    main()
