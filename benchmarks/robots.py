"""Speed of evaluation on the robots: N rollouts stepped together, against one after the other.

`python -m benchmarks.robots [--copies 1000] [--episodes 50] [--repetitions 3]` prints a table of
environment steps per second. Ours is the project's evaluation with its distance to a behaviour
policy. The plain loop is how policies are commonly evaluated: one Gymnasium environment, one state
at a time through the network, return only; it runs the first of the same episodes. Only steps until
a fall count, on both sides.
"""

import argparse
from collections.abc import Callable
from functools import partial

import gymnasium as gym
import numpy as np
import torch

from benchmarks.measure import computer, markdown, median_seconds
from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator
from components.environments.mujoco.specifications import ROBOTS, simulator_version
from components.environments.systems import make_batch
from components.evaluation.protocol import EvaluationProtocol
from components.evaluation.real import PolicyReturns, evaluate_policies
from components.networks import StackedMLP
from components.policies.policy import Policy, PolicyCard

__all__ = ["evaluated", "plain_returns", "report", "untrained_policy"]

_ROBOTS = tuple(robot.id for robot in ROBOTS.values())
_STREAM = 0
_DISCOUNT = 0.99
_PLAIN = "Python loop over one environment"
_THREADS = (1, 2)


def untrained_policy(name: str, hidden: tuple[int, ...] = (256, 256)) -> Policy:
    """A randomly initialised policy of this robot's shape."""
    robots = make_batch(name, 1)
    features, actions = robots.frame_features, len(robots.action_features)
    network = StackedMLP([lane_generator(1)], (len(features), *hidden, actions))
    card = PolicyCard(
        algorithm="untrained",
        dataset="none",
        features=features,
        history=1,
        actions=actions,
        takes_proximity=False,
        steps=(0,),
    )
    scaling = Normaliser(torch.zeros(1, len(features)), torch.ones(1, len(features)))
    return Policy.of_networks(card, {"actor": network.affine()}, scaling)


@torch.inference_mode()
def plain_returns(
    policy: Policy, name: str, episodes: int, protocol: EvaluationProtocol
) -> tuple[list[float], int]:
    """Discounted return of every episode, one robot and one state at a time; and their steps."""
    environment = gym.make(name, disable_env_checker=True)
    environment.unwrapped.np_random = lane_generator(_STREAM)
    returns, steps = [], 0
    for _ in range(episodes):
        frame, _ = environment.reset()
        total = 0.0
        for t in range(protocol.horizon):
            x = policy.frames.apply(torch.from_numpy(frame).float()[None])
            for weight, bias in policy.layers[:-1]:
                x = torch.relu(x @ weight[0] + bias[0])
            weight, bias = policy.layers[-1]
            action = torch.tanh(x @ weight[0] + bias[0])
            frame, reward, terminated, *_ = environment.step(action[0].double().numpy())
            total += _DISCOUNT**t * float(reward)
            steps += 1
            if terminated:
                break
        returns.append(total)
    return returns, steps


def evaluated(
    policy: Policy, name: str, protocol: EvaluationProtocol, threads: int
) -> PolicyReturns:
    """The project's evaluation of the same policy from the same starts."""
    device = torch.device("cpu")
    [result] = evaluate_policies(
        [policy], [policy], name, {}, protocol, _DISCOUNT, [_STREAM], device, threads=threads
    )
    return result


def _steps(policy: Policy, name: str, protocol: EvaluationProtocol) -> int:
    """Environment steps until falls in the project's evaluation of this policy."""
    robots = make_batch(name, protocol.trajectories)
    frames, steps = robots.reset(lane_generator(_STREAM)), 0
    for _ in range(protocol.horizon):
        steps += int(np.count_nonzero(~robots.terminated))
        actions = policy.act(torch.from_numpy(frames).float()[None, :, None])
        frames, _ = robots.step(actions[0].numpy())
    return steps


def _rates(name: str, copies: int, episodes: int, repetitions: int) -> dict[str, float]:
    """Environment steps per second of one robot, by program."""
    protocol = EvaluationProtocol(trajectories=copies)
    policy = untrained_policy(name)
    programs: dict[str, Callable[[], object]] = {
        _PLAIN: lambda: plain_returns(policy, name, episodes, protocol)
    }
    counts = {_PLAIN: plain_returns(policy, name, episodes, protocol)[1]}
    together = _steps(policy, name, protocol)
    for threads in _THREADS:
        program = f"{copies} together, {threads} thread(s)"
        programs[program] = partial(evaluated, policy, name, protocol, threads)
        counts[program] = together
    seconds = median_seconds(programs, repetitions)
    return {program: counts[program] / seconds[program] for program in programs}


def report(copies: int = 1000, episodes: int = 50, repetitions: int = 3) -> str:
    """Measure all robots; a Markdown table.

    Args:
        copies: Rollouts stepped together.
        episodes: Of the plain loop.
        repetitions: Of each measurement, in turn; the median counts.
    """
    rows = []
    for name in _ROBOTS:
        rates = _rates(name, copies, episodes, repetitions)
        rows += [
            [name.split("/")[1], program, f"{rate:,.0f}", f"{rate / rates[_PLAIN]:.1f}"]
            for program, rate in rates.items()
        ]
    return markdown(["robot", "evaluation", "steps per second", "times plain"], rows, texts=2)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robots", description=__doc__)
    parser.add_argument("--copies", type=int, default=1000)
    parser.add_argument("--episodes", type=int, default=50, help="of the plain loop")
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    print(report(options.copies, options.episodes, options.repetitions))
    print(f"\n{computer()}; {simulator_version()}")


if __name__ == "__main__":
    main()
