"""A session of turning the proximity: what the operator's copy does, and the behaviour's beside it.

A session is advanced by :meth:`Session.step`; between steps anybody may set the proximity, the
driver and the setpoint, or restart it. It is a function of its seed and of what was set when, so a
recording (:mod:`.recording`) can be replayed.
"""

from dataclasses import dataclass
from typing import Final, Literal, Protocol, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from components.core.random_streams import lane_generator, lane_key
from components.environments.frame_history import FrameHistory
from components.operating.operable import Operable
from components.operating.plants import COPIES, Plant, plant_of
from components.policies.policy import Policy

__all__ = ["DRIVERS", "Driver", "Pilot", "Session", "Step"]

Driver = Literal["operator", "behaviour", "autopilot"]
DRIVERS: Final[tuple[Driver, ...]] = get_args(Driver)
"""Who operates the first copy: the policy at the operator's proximity, the behaviour, or the policy
at the proximity that a pilot chooses."""

_STRAYED: Final = 3  # steps in a row outside of the log that make a warning
_TINY: Final = 1e-9  # where a log never changes, whatever differs is strange

Array = NDArray[np.float64]


class Pilot(Protocol):
    """Chooses the proximity from what it is told, see :class:`.flying.Flying`."""

    @property
    def landed(self) -> bool:
        """Whether the next step has to be the first of an episode."""

    def propose(self) -> float:
        """The proximity of the next step, 0 to 1."""

    def tell(self, reward: float) -> None:
        """What a step earned."""

    def ended(self) -> None:
        """The episode has ended before the pilot's trajectory."""

    def forget(self) -> None:
        """Somebody else drives, or the episode was broken off."""


@dataclass(frozen=True)
class Step:
    """What happened in one step; pairs are the operated copy's and the behaviour's.

    Attributes:
        episode: Number of the episode, from 0.
        step: Within it, from 0.
        driver: Of the operated copy.
        proximity: That the policy was given.
        setpoint: That was demanded; NaN where there is none.
        frames: `[2, F]` in which was acted.
        actions: `[2, A]` in [-1, 1].
        rewards: `[2]`.
        ended: Whether the operated copy has ended, e.g. by a fall.
        distance: Between the operated copy's action and the behaviour's in the same state.
        strangeness: Distance of the operated copy's state to the log; above 1 it has left it. NaN
            where that is not known.
    """

    episode: int
    step: int
    driver: Driver
    proximity: float
    setpoint: float
    frames: Array
    actions: Array
    rewards: Array
    ended: bool
    distance: float
    strangeness: float


class Session:
    """Two copies of a plant in lock-step.

    Args:
        operable: What is operated.
        seed: Of starts and noise.
        pilot: The third driver, if there is one.
        plant: Where; by default the system that the log's card names, or else the log.

    Attributes:
        operable: As given.
        seed: As given.
        plant: Where it acts.
        episode: Number of the present episode.
        at: Steps taken in it.
        frames: `[2, F]` the present frames.
        sums: `[2]` rewards of the present episode.
        over: Whether the next step begins another episode.

    Raises:
        ValueError: There is neither a system nor a log, or the policy does not see its frames.
    """

    def __init__(
        self,
        operable: Operable,
        seed: int = 0,
        pilot: Pilot | None = None,
        plant: Plant | None = None,
    ) -> None:
        self.operable, self.seed, self._pilot = operable, seed, pilot
        self.plant = plant or plant_of(operable.card, operable.log)
        self.takes_proximity = operable.policy.card.takes_proximity
        self._proximity = 0.0
        self._driver: Driver = "operator"
        self.episode, self.over = -1, True
        self.restart()
        if self.frames.shape[1] != len(operable.policy.card.features):
            raise ValueError(
                f"The policy sees {', '.join(operable.policy.card.features)}, which "
                f"{operable.card.environment or operable.card.name} does not show."
            )

    @property
    def proximity(self) -> float:
        """Lambda: 0 is familiar, 1 is what the models think is best."""
        return self._proximity

    @proximity.setter
    def proximity(self, value: float) -> None:
        if not 0.0 <= value <= 1.0:  # false for NaN, too
            raise ValueError(f"proximity={value} must lie in [0, 1].")
        self._proximity = float(value)

    @property
    def driver(self) -> Driver:
        """Who operates the first copy."""
        return self._driver

    @driver.setter
    def driver(self, name: Driver) -> None:
        if name not in self.drivers:
            raise ValueError(f"driver={name} is unknown; known are {', '.join(self.drivers)}.")
        if self._pilot is not None and name != self._driver:
            self._pilot.forget()
            # What the pilot is told must be of whole episodes.
            self.over = self.over or name == "autopilot"
        self._driver = name

    @property
    def drivers(self) -> tuple[Driver, ...]:
        """Who can operate it: an autopilot only where there is one and a proximity to turn."""
        flown = self._pilot is not None and self.takes_proximity
        return DRIVERS if flown else DRIVERS[:2]

    @property
    def strayed(self) -> bool:
        """Whether the operated copy has left the log's states, for several steps in a row."""
        return self._outside >= _STRAYED

    def restart(self) -> None:
        """Begin the next episode."""
        if self._pilot is not None and not self.over:
            self._pilot.forget()
        self.episode += 1
        self.frames = self.plant.start(self.seed, self.episode)
        card = self.operable.policy.card
        behaviour = self.operable.behaviour
        self._seen = FrameHistory(self.frames, card.history)
        self._seen_by_behaviour = FrameHistory(
            self.frames, card.history if behaviour is None else behaviour.card.history
        )
        self._noise = lane_generator(lane_key("candidates", self.seed, self.episode))
        self.at, self.over, self._outside = 0, False, 0
        self.sums: Array = np.zeros(COPIES)

    def step(self) -> Step:
        """Act once in both copies; after the end of an episode, in the next one."""
        if self.over:
            self.restart()
        if self._driver == "autopilot" and self._pilot is not None:
            self.proximity = self._pilot.propose()
        usual = self._usual()  # [2, A] in both copies' states
        chosen = self._chosen() if self._driver != "behaviour" else usual[0]
        actions = np.stack([chosen, usual[1]])
        strangeness = self._strangeness()
        before = self.frames
        self.frames, rewards, ended = self.plant.step(actions)
        for seen in (self._seen, self._seen_by_behaviour):
            seen.push(self.frames)
        self.sums = self.sums + rewards
        self._outside = self._outside + 1 if strangeness > 1 else 0
        done = Step(
            self.episode,
            self.at,
            self._driver,
            self._proximity,
            float("nan") if self.plant.setpoint is None else self.plant.setpoint,
            before,
            actions,
            rewards,
            bool(ended[0]),
            float(np.linalg.norm(chosen - usual[0])),
            strangeness,
        )
        self.at += 1
        self.over = bool(ended[0]) or self.at >= self.plant.horizon
        if self._driver == "autopilot" and self._pilot is not None:
            self._pilot.tell(float(rewards[0]))
            if self.over:
                self._pilot.ended()
            self.over = self.over or self._pilot.landed
        return done

    def actions_at(self, frames: Array) -> Array:
        """The policy's actions `[N, A]` at this proximity in frames `[N, F]` that have lasted."""
        card = self.operable.policy.card
        windows = np.repeat(np.asarray(frames)[:, None], card.history, axis=1)
        return self._act(self.operable.policy, windows)

    def _usual(self) -> Array:
        """What the behaviour does in the states of both copies, `[2, A]`."""
        logged = self.plant.logged()
        if logged is not None:
            return np.stack([logged] * COPIES)
        clone = self.operable.behaviour
        if clone is not None:
            return self._act(clone, self._seen_by_behaviour.window)
        return self._act(self.operable.policy, self._seen.window, familiar=True)

    def _chosen(self) -> Array:
        """What the policy does in the operated copy's state, `[A]`."""
        chosen: Array = self._act(self.operable.policy, self._seen.window[:1])[0]
        return chosen

    def _act(self, policy: Policy, windows: Array, *, familiar: bool = False) -> Array:
        card, count = policy.card, len(windows)
        proximity = noise = None
        if card.takes_proximity:
            proximity = torch.full((1, count), 0.0 if familiar else self._proximity)
        if card.candidates:
            drawn = self._noise.standard_normal((1, count, card.candidates, card.noise), np.float32)
            noise = torch.from_numpy(drawn)
        seen = torch.from_numpy(np.ascontiguousarray(windows)).float()[None]
        actions = policy.act(seen, proximity, noise)[0].numpy().astype(np.float64)
        # A sick policy must not stop the machine: what is no number is no change.
        return np.nan_to_num(actions, nan=0.0, posinf=1.0, neginf=-1.0)

    def _strangeness(self) -> float:
        familiar = self.operable.familiar
        if familiar is None:
            return float("nan")
        return float(familiar.distances(self.frames[0]) / max(familiar.limit, _TINY))
