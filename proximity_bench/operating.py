"""A policy at work in the real system, step by step, and a slider that turns its proximity."""

from io import BytesIO
from typing import TYPE_CHECKING, Any

import pandas as pd

from components.core.random_streams import lane_generator, lane_key
from components.environments.frame_history import FrameHistory
from components.environments.systems import SYSTEMS, make_batch
from components.reporting.trajectories import trajectory_figure
from proximity_bench.policies import Policy

if TYPE_CHECKING:  # an extra: only those who work with notebooks have it
    from ipywidgets import VBox

__all__ = ["operate", "trajectory"]


def trajectory(
    policy: Policy, proximity: float | None = None, *, steps: int = 100, seed: int = 0
) -> pd.DataFrame:
    """Let a policy act in the real system that its log's card names.

    The system's start and its noise depend on the seed alone: trajectories at several proximities
    differ by what the policy does.

    Args:
        policy: With the card of its log.
        proximity: Needed exactly by policies that take it.
        steps: At most; a system that ends, such as a robot that falls, ends the trajectory.
        seed: Of the system.

    Returns:
        A row a step: the features of the frame after it, `action NAME` in [-1, 1], and `reward`.

    Raises:
        ValueError: There is no such system, or the proximity does not suit.
    """
    if policy.log is None or policy.log.environment not in SYSTEMS:
        raise ValueError(
            f"{policy!r} names no registered system to act in; registered are {', '.join(SYSTEMS)}."
        )
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}.")
    system = make_batch(policy.log.environment, 1, **policy.log.environment_parameters)
    key = lane_key("trajectory", seed)
    history = FrameHistory(system.reset(lane_generator(key)), policy.history)
    candidates = lane_generator(lane_key(key, "candidates"))
    rows = []
    for _ in range(steps):
        oldest_first = history.window[0, ::-1]
        action = policy.act(oldest_first, proximity, scaled=True, noise=candidates)
        frames, rewards = system.step(action[None])
        history.push(frames)
        rows.append([*frames[0], *action, rewards[0]])
        if system.terminated[0]:
            break
    actions = [f"action {name}" for name in system.action_features]
    return pd.DataFrame(rows, columns=[*system.frame_features, *actions, "reward"])


def operate(policy: Policy, *, steps: int = 100, seed: int = 0) -> "VBox":
    """A slider from familiar to better, and what the machine makes of it; for notebooks.

    Args:
        policy: One that takes a proximity, with the card of a log whose system is registered.
        steps: Of a trajectory.
        seed: Of the system.

    Returns:
        The slider above the figure: rewards and frames at this proximity and at 0. Turning it lets
        the policy act again from the same start.

    Raises:
        ValueError: The policy takes no proximity, or has no system.
        ImportError: The package `ipywidgets` is missing.
    """
    if not policy.takes_proximity:
        raise ValueError(f"A policy of {policy.algorithm} takes no proximity to be turned.")
    from ipywidgets import FloatSlider, Image, VBox

    familiar = trajectory(policy, 0.0, steps=steps, seed=seed)
    slider = FloatSlider(
        value=0.0, min=0.0, max=1.0, step=0.05, description="proximity", readout_format=".2f"
    )
    shown = Image(format="png")

    def act(change: Any) -> None:
        proximity = float(slider.value)
        now = trajectory(policy, proximity, steps=steps, seed=seed)
        names = {"0": familiar, f"{proximity:g}": now}
        figure = trajectory_figure(names, policy.features, _discount(policy))
        drawn = BytesIO()
        figure.savefig(drawn, format="png")
        shown.value = drawn.getvalue()

    slider.observe(act, names="value")
    act(None)
    return VBox([slider, shown])


def _discount(policy: Policy) -> float:
    return 1.0 if policy.log is None else policy.log.discount
