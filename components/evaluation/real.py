"""Roll stored policies out on the real system and compute their discounted returns.

All snapshots, all proximities and all repetitions of a policy run as copies of one vectorised
environment; policies of several seeds act in one stacked forward pass. Every policy stack has its
own environment and its own random stream, so its numbers do not depend on what is evaluated beside
it. The return is ``sum_t gamma^t r_t`` over the horizon from a fresh start. A termination is
absorbing: the reward of the step that ends in it counts, all later ones are zero. A trajectory with
an infinite or undefined action has no return, whatever the system made of it: NaN.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from components.core.random_streams import lane_generator, lane_key
from components.environments.frame_history import FrameHistory
from components.environments.systems import make_batch
from components.evaluation.protocol import EvaluationProtocol
from components.policies.policy import Policy

__all__ = ["PolicyReturns", "evaluate_policies"]


@dataclass(frozen=True)
class PolicyReturns:
    """What one stack of S snapshots achieved.

    Attributes:
        proximities: ``[N]`` the grid, or a single NaN for policies that take none.
        returns: ``[S, N, trajectories]`` discounted returns.
        distances: ``[S, N]`` mean Euclidean distance to the behaviour policy's action over
            all visited states, a terminal one and what follows it excluded.
    """

    proximities: npt.NDArray[np.float64]
    returns: npt.NDArray[np.float64]
    distances: npt.NDArray[np.float64]


def evaluate_policies(
    policies: Sequence[Policy],
    behaviours: Sequence[Policy] | None,
    environment: str,
    parameters: Mapping[str, Any],
    protocol: EvaluationProtocol,
    discount: float,
    keys: Sequence[int],
    device: torch.device,
    progress: Callable[[float], None] = lambda fraction: None,
    threads: int = 1,
) -> list[PolicyReturns]:
    """Evaluate stacks of snapshots, all of them at once.

    Args:
        policies: Stacks of S snapshots each (one per seed), of equal shapes.
        behaviours: For each stack the behaviour policy to measure the distance to; None: there is
            none, and distances are NaN.
        environment: Gymnasium id of the real system.
        parameters: Its parameters, such as the setpoint.
        protocol: Trajectories, horizon and grid of proximities.
        discount: Gamma of the reported return, above 0 and at most 1.
        keys: One random stream per stack.
        device: Where the policies act.
        progress: Called with the finished fraction, 0 to 1.
        threads: Number of threads that step the real systems.

    Returns:
        One result per stack.

    Raises:
        ValueError: The discount is outside its range, or the policies do not see the system's
            frames.
    """
    if not 0 < discount <= 1:
        raise ValueError(f"discount must lie in (0, 1], got {discount}.")
    takes_proximity = policies[0].card.takes_proximity
    grid = protocol.proximities if takes_proximity else (float("nan"),)
    snapshots, repeats = policies[0].lanes, protocol.trajectories
    per_policy = len(grid) * repeats
    actors = Policy.concatenate(policies[0].card, policies).to(device)
    behaviour = None
    if behaviours is not None:
        behaviour = Policy.concatenate(behaviours[0].card, behaviours).to(device)
    grid_values = torch.tensor(grid, device=device).repeat_interleave(repeats)
    proximity = grid_values.expand(actors.lanes, -1) if takes_proximity else None
    systems = [
        make_batch(environment, snapshots * per_policy, threads, **parameters) for _ in policies
    ]
    shown = tuple(systems[0].frame_features)
    if actors.card.features != shown:
        raise ValueError(
            f"{actors.card.dataset} logs {actors.card.features}, but {environment} shows {shown}; "
            "log these, or leave the environment on the card of the log empty."
        )
    histories = [
        FrameHistory(system.reset(lane_generator(key)), actors.card.history)
        for system, key in zip(systems, keys, strict=True)
    ]
    shape = (len(policies), snapshots * per_policy)
    noises = [lane_generator(lane_key(key, "candidates")) for key in keys]
    drawn = (snapshots, per_policy, actors.card.candidates, actors.card.noise)
    returns, distance, visited = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    running, undefined = np.ones(shape, dtype=np.bool_), np.zeros(shape, dtype=np.bool_)
    for t in range(protocol.horizon):
        windows = torch.from_numpy(np.stack([h.window for h in histories])).float().to(device)
        seen = windows.view(actors.lanes, per_policy, *windows.shape[2:])
        noise = None
        if actors.card.candidates:
            fresh = [generator.standard_normal(drawn, np.float32) for generator in noises]
            noise = torch.from_numpy(np.concatenate(fresh)).to(device)
        actions = actors.act(seen, proximity, noise).view(*shape, -1)
        if behaviour is not None:
            apart: Tensor = torch.linalg.vector_norm(actions - behaviour.act(windows), dim=-1)
            np.add(distance, apart.cpu().numpy(), out=distance, where=running)
        visited += running
        chosen = actions.cpu().numpy().astype(np.float64)
        undefined |= running & ~np.isfinite(chosen).all(axis=-1)
        chosen[undefined] = 0.0  # systems refuse undefined actions, those of neighbours too
        for number, (system, history) in enumerate(zip(systems, histories, strict=True)):
            frames, rewards = system.step(chosen[number])
            history.push(frames)
            returns[number] += discount**t * np.where(running[number], rewards, 0.0)
            running[number] &= ~system.terminated
        over = not running.any()
        progress(1.0 if over else (t + 1) / protocol.horizon)
        if over:
            break
    returns[undefined] = np.nan
    if behaviour is None:
        distance[:] = np.nan
    by_policy = (len(policies), snapshots, len(grid), repeats)
    total, states = (array.reshape(by_policy).mean(axis=-1) for array in (distance, visited))
    return [
        PolicyReturns(np.array(grid), r, d)
        for r, d in zip(returns.reshape(by_policy), total / states, strict=True)
    ]
