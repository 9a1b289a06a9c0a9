"""A policy at work in the real system, step by step, and a slider that turns its proximity."""

import warnings
from io import BytesIO
from typing import TYPE_CHECKING, Any

import pandas as pd
import PIL.Image

from components.core.random_streams import lane_generator, lane_key
from components.data.card import DatasetCard
from components.environments.frame_history import FrameHistory
from components.environments.systems import SYSTEMS, make_batch
from components.operating.operable import Operable, newest
from components.operating.scene import Scene
from components.operating.session import Session
from proximity_bench.histories import FarFromLogWarning
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
    card = _running(policy)
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}.")
    system = make_batch(card.environment, 1, **card.environment_parameters)
    key = lane_key("trajectory", seed)
    history = FrameHistory(system.reset(lane_generator(key)), policy.history)
    candidates = lane_generator(lane_key(key, "candidates"))
    rows = []
    for _ in range(steps):
        oldest_first = history.window[0, ::-1]
        with warnings.catch_warnings():
            # A system speaks in the log's units; where a policy leads it is what is looked at.
            warnings.simplefilter("ignore", FarFromLogWarning)
            action = policy.act(oldest_first, proximity, scaled=True, noise=candidates)
        frames, rewards = system.step(action[None])
        history.push(frames)
        rows.append([*frames[0], *action, rewards[0]])
        if system.terminated[0]:
            break
    actions = [f"action {name}" for name in system.action_features]
    return pd.DataFrame(rows, columns=[*system.frame_features, *actions, "reward"])


def operate(policy: Policy, *, steps: int = 100, seed: int = 0) -> "VBox":
    """The console's scene in a notebook: turn the proximity while the machine runs.

    Args:
        policy: One that takes a proximity, with the card of a log whose system is registered.
        steps: Of the session.
        seed: Of starts and noise.

    Returns:
        The slider from familiar to better, a button that plays, and the picture: this policy, and
        beside it the behaviour from the same start and with the same noise. Going back in the
        player begins again.

    Raises:
        ValueError: The policy takes no proximity, or has no system.
        ImportError: The package `ipywidgets` is missing.
    """
    if not policy.takes_proximity:
        raise ValueError(f"A policy of {policy.algorithm} takes no proximity to be turned.")
    card = _running(policy)
    from ipywidgets import FloatSlider, HBox, Image, Label, Play, VBox

    clone = policy.behaviour
    operable = Operable(newest(policy.stack), None if clone is None else newest(clone), card)
    slider = FloatSlider(value=0.0, min=0.0, max=1.0, step=0.05, readout_format=".2f")
    play = Play(min=0, max=steps, step=1, interval=100)
    shown = Image(format="png")
    scenes = [Scene(Session(operable, seed), steps)]

    def show() -> None:
        drawn = BytesIO()
        PIL.Image.fromarray(scenes[0].picture()).save(drawn, "PNG")
        shown.value = drawn.getvalue()

    def act(change: Any) -> None:
        taken = len(scenes[0].past.proximities)
        if play.value < taken:
            scenes[0], taken = Scene(Session(operable, seed), steps), 0
        scenes[0].session.proximity = float(slider.value)  # of a scene begun again, too
        for _ in range(taken, play.value):
            scenes[0].step()
        show()

    for part in (play, slider):
        part.observe(act, names="value")
    show()
    dial = HBox([Label("familiar"), slider, Label("better"), play])
    return VBox([dial, shown])


def _running(policy: Policy) -> DatasetCard:
    """The card of a policy's log, whose system is registered.

    Raises:
        ValueError: There is none.
    """
    if policy.log is None or policy.log.environment not in SYSTEMS:
        raise ValueError(
            f"{policy!r} names no registered system to act in; registered are {', '.join(SYSTEMS)}."
        )
    return policy.log
