"""A linear robot that falls over, and its logs: the second world in which learners are tested.

It shows three numbers and is told two torques; nothing of it is known but these. It falls where its
tilt leaves a range; an episode ends there, or by time. Everything is linear, the reward included,
which is paid on the fatal step too.
"""

import dataclasses

import numpy as np

from components.data.dataset import OfflineDataset
from tests.components.synthetic import make_log, relabelled

FEATURES = ("tilt", "speed", "bend")
ACTIONS = ("hip", "knee")
DYNAMICS = np.array([[0.95, 0.1, 0.0], [0.0, 0.8, 0.1], [-0.1, 0.0, 0.7]])
TORQUES = np.array([[0.3, 0.1], [0.3, -0.1], [0.0, 0.4]])
LIMIT = 0.6
HEALTHY = {"tilt": [-LIMIT, LIMIT], "speed": [None, 50.0]}


def next_state(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    """States ``[..., 3]`` after actions ``[..., 2]``."""
    return state @ DYNAMICS.T + action @ TORQUES.T


def reward(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Of a step, from the state and the action before it."""
    return 1.0 + next_state(state, action)[..., 1] - 0.2 * action[..., 0]


def fallen(state: np.ndarray) -> np.ndarray:
    """Whether states ``[..., 3]`` are terminal."""
    return np.abs(state[..., 0]) >= LIMIT


def make_robot_log(
    name: str = "robot",
    *,
    seed: int = 0,
    episodes: int = 24,
    steps: int = 25,
    feedback: float = 0.5,
) -> OfflineDataset:
    """Log the robot; noisy linear feedback keeps its tilt small, and now and then it falls."""
    rng = np.random.default_rng(seed)
    frames, actions, rewards, terminated, ends = [], [], [], [], []
    for _ in range(episodes):
        state = rng.uniform(-0.3, 0.3, 3)
        frames.append(state)
        for _ in range(steps):
            noise = rng.normal(0.0, 0.6, 2)
            # Rounded before the robot is told, as in all logs.
            action = np.float32(np.clip(-feedback * state[:2] + noise, -1.0, 1.0))
            rewards.append(reward(state, action))
            state = next_state(state, action)
            frames.append(state)
            actions.append(action)
            terminated.append(fallen(state))
            if terminated[-1]:
                break
        ends.append(len(rewards))
    starts = np.array([0, *ends])
    ended = np.array(terminated, dtype=np.bool_)
    truncated = np.zeros_like(ended)
    truncated[starts[1:] - 1] = ~ended[starts[1:] - 1]
    card = dataclasses.replace(
        make_log().card,
        name=name,
        trajectories=episodes,
        steps=steps,
        transitions=len(rewards),
        discount=0.99,
        history=1,
        frame_features=FEATURES,
        action_features=ACTIONS,
        dynamics={
            "known": {
                "features": list(ACTIONS),
                "keep": [0.0, 0.0],
                "scale": [1.0, 1.0],
                "low": -1.0,
                "high": 1.0,
            },
            "learned": [*FEATURES, "reward"],
            "reward": {"reward": 1.0},
            "healthy": HEALTHY,
        },
        all_windows_return_mean=20.0,
    )
    return relabelled(
        OfflineDataset(
            card=card,
            frames=np.array(frames, dtype=np.float32),
            actions=np.array(actions, dtype=np.float32),
            rewards=np.array(rewards, dtype=np.float32),
            terminated=ended,
            truncated=truncated,
            episode_starts=starts,
        )
    )
