"""The Industrial Benchmark, N independent copies at once.

A stochastic, partially observed control problem made to behave like a gas turbine: three steerings
(velocity, gain, shift) trade fatigue against consumption, with costs that arrive five to nine
steps late and a mis-calibration that is punished by a hidden oscillator.

Source: thesis section 3.1, equations 3.1-3.27, corrected to the reference implementation (the
recordings in tests/data replay to rounding). Deviations from the thesis text: the penalty is
25 (1 + potential); the consumption's noise has the deviation 1 + 0.005 c; fatigue is divided by 3
and its numerator is 30000; the logistic branch of equation 3.19 holds at the cap 5.0; the
effective velocity is one minus equation 3.20; noise as in `noise.py`; safe zone as in
`goldstone.py`.

Shapes: actions `[N, 3]`, frames `[N, 6]`, rewards `[N]`; inside, quantities come first and copies
last so that every operation runs over contiguous memory. One step is a fixed number of array
operations into buffers allocated once.
"""

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from components.environments.industrial.arithmetic import number
from components.environments.industrial.fatigue import Fatigue
from components.environments.industrial.goldstone import decode_latents
from components.environments.industrial.mis_calibration import MisCalibration
from components.environments.industrial.noise import DrawnNoise, NoiseSource
from components.environments.industrial.start_state import StartState

__all__ = ["DYNAMICS", "FRAME_FEATURES", "STEERINGS", "IndustrialBenchmark"]

FRAME_FEATURES: Final = ("setpoint", "velocity", "gain", "shift", "fatigue", "consumption")
"""Names of the six values of a frame, in order."""
STEERINGS: Final = ("velocity", "gain", "shift")
"""Names of the three steerings; an action holds the wanted change of each, in this order."""

_STEP_SIZES = np.array([[1.0], [10.0], [20.0 * math.sin(math.radians(15.0)) / 0.9]])
DYNAMICS: Final[Mapping[str, Any]] = {
    "known": {
        "features": ["setpoint", *STEERINGS],
        "keep": [1.0] * 3,
        "scale": [float(size) for size in _STEP_SIZES[:, 0]],
        "low": 0.0,
        "high": 100.0,
    },
    "learned": ["fatigue", "consumption"],
    "reward": {"fatigue": -0.03, "consumption": -0.01},
}
"""The dynamics specification, known without data: the effect of an action on the steerings, and the
reward of a frame."""

_COST_WEIGHTS = np.array([0.11111, 0.22222, 0.33333, 0.22222, 0.11111, 0.0, 0.0, 0.0, 0.0, 0.0])
_COST_RATES = np.array([0.04, 0.025, 0.0])
_REWARD_RATES = np.array([-0.03, -0.01])
_COST_STEPS = _COST_WEIGHTS.size
_PENALTY, _CONSUMPTION_SPREAD, _ONE = number(25.0), number(0.005), number(1.0)
_WORTH_A_THREAD = 500  # copies; for fewer, asking another thread takes longer than their draws

Array = NDArray[np.float64]


class IndustrialBenchmark:
    """N copies of the Industrial Benchmark with one setpoint.

    Args:
        copies: number of copies N.
        setpoint: load demanded from the machine, 0 ... 100.
        threads: with 2 or more, and many copies, one draws the noise of coming steps while another
            moves the copies; the numbers do not depend on it.

    Attributes:
        frame_features: `FRAME_FEATURES`.
        action_features: `STEERINGS`.
        terminated: `[N]` all false: the machine never terminates.

    Raises:
        ValueError: a copy or thread count below one, or a setpoint outside 0 ... 100.
    """

    def __init__(self, copies: int, setpoint: float = 70.0, threads: int = 1) -> None:
        if copies < 1 or threads < 1:
            raise ValueError(f"copies is {copies} and threads is {threads}; give at least 1.")
        if not 0.0 <= setpoint <= 100.0:
            raise ValueError(f"setpoint is {setpoint}; give a number from 0 to 100.")
        self.copies = copies
        self.setpoint = float(setpoint)
        self.frame_features = FRAME_FEATURES
        self.action_features = STEERINGS
        self.terminated = np.zeros(copies, dtype=np.bool_)
        # row k: the weights of the cost ring when its oldest entry sits in row k
        self._ring_weights = np.stack([np.roll(_COST_WEIGHTS, k) for k in range(_COST_STEPS)])
        self._setpoint_cost = number(0.02 * self.setpoint)
        self._noise: NoiseSource | None = None
        several = threads > 1 and copies >= _WORTH_A_THREAD
        self._later = ThreadPoolExecutor(1).submit if several else None
        self._allocate()

    def demand(self, setpoint: float) -> None:
        """Demand another load from all copies, from the next step on.

        Args:
            setpoint: 0 ... 100.

        Raises:
            ValueError: a setpoint outside 0 ... 100.
        """
        if not 0.0 <= setpoint <= 100.0:
            raise ValueError(f"setpoint is {setpoint}; give a number from 0 to 100.")
        self.setpoint = float(setpoint)
        self._setpoint_cost = number(0.02 * self.setpoint)
        self._fatigue.demand(self.setpoint)
        self._mis_calibration.demand(self.setpoint)

    def _allocate(self) -> None:
        n = self.copies
        self._steerings = np.zeros((3, n))
        self._fatigue = Fatigue(n, self.setpoint)
        self._mis_calibration = MisCalibration(n, self.setpoint)
        self._costs = np.zeros((_COST_STEPS, n))  # ring; row _oldest is overwritten next
        self._oldest = 0
        self._convolved = np.zeros(n)
        self._delta = np.empty((3, n))
        # whole arrays of limits: NumPy is twice as fast on them as on broadcast numbers
        self._zeros, self._ones = np.zeros((3, n)), np.ones((3, n))
        self._minus_ones, self._hundreds = -self._ones, 100.0 * self._ones
        self._step_sizes = _STEP_SIZES * self._ones
        self._cost, self._spread = np.empty((2, n))
        self._columns = np.zeros((6, n))
        self._rewards = np.zeros(n)

    def reset(
        self,
        rng: np.random.Generator | None = None,
        *,
        start: Mapping[str, ArrayLike] | None = None,
        noise: NoiseSource | None = None,
    ) -> Array:
        """Start all copies and take the one step of action zero that the reference takes.

        Args:
            rng: generator of all noise from here on; without it the previous one is used further.
            start: state before that first step, numbers or arrays `[N]`: `velocity`, `gain`,
                `shift`, `hidden_velocity`, `hidden_gain`, `domain`, `response`, `direction`
                (`START_DEFAULTS`), and `operational_costs`, `[10]` or `[N, 10]` oldest first
                (default: the cost of the steerings at every past step).
            noise: injected draws of the first step.

        Returns:
            `[N, 6]` the first frame of every copy.

        Raises:
            ValueError: no generator at the first reset, or a start that is unknown or out of
                range.
        """
        if rng is not None:
            self._noise = DrawnNoise(rng, self.copies, self._later)
        if self._noise is None and noise is None:
            raise ValueError(
                "the first reset needs a generator; pass rng=numpy.random.default_rng(seed)."
            )
        self._begin(StartState.resolve(start or {}, self.copies))
        return self.step(np.zeros((self.copies, 3)), noise)[0]

    def reset_copies(
        self,
        copies: NDArray[np.bool_],
        rng: np.random.Generator,
        *,
        start: Mapping[str, ArrayLike] | None = None,
    ) -> Array:
        """Start some of the copies again while the others stay where they are.

        Args:
            copies: `[N]` mask of the copies to start again.
            rng: generator of their first step; later steps use that of `reset`.
            start: as in `reset`, arrays as long as the mask has true entries.

        Returns:
            `[copies.sum(), 6]` their first frames.
        """
        chosen = np.flatnonzero(copies)
        if chosen.size == 0:
            return np.empty((0, 6))
        fresh = IndustrialBenchmark(chosen.size, self.setpoint)
        frames = fresh.reset(rng, start=start)
        self._steerings[:, chosen] = fresh._steerings
        self._fatigue.replace(chosen, fresh._fatigue)
        self._mis_calibration.replace(chosen, fresh._mis_calibration)
        self._convolved[chosen] = fresh._convolved
        self._costs[:, chosen] = np.roll(fresh._costs, self._oldest - fresh._oldest, axis=0)
        self._columns, self._rewards = self._columns.copy(), self._rewards.copy()
        self._columns[:, chosen], self._rewards[chosen] = fresh._columns, fresh._rewards
        return frames

    def _begin(self, start: StartState) -> None:
        self._steerings[:] = start.steerings
        self._fatigue.hidden[:] = start.hidden
        self._mis_calibration.latents[:] = 3 * start.latents + 1
        self._oldest = 0
        costs = start.operational_costs
        self._costs[:] = self._operational_cost(np.empty(self.copies)) if costs is None else costs

    def step(self, actions: ArrayLike, noise: NoiseSource | None = None) -> tuple[Array, Array]:
        """Move every copy by one step.

        Args:
            actions: `[N, 3]` wanted changes of velocity, gain and shift, clipped to [-1, 1].
            noise: injected draws; without them the generator of the last reset is used.

        Returns:
            The new frames `[N, 6]` and the rewards `[N]` of the new state,
            -(3 fatigue + consumption) / 100; both arrays are the caller's to keep.

        Raises:
            ValueError: a wrong shape, a value that is not a number, or no reset before.
        """
        wanted = np.asarray(actions, dtype=np.float64)
        if wanted.shape != (self.copies, 3):
            raise ValueError(
                f"actions have the shape {wanted.shape}; {self.copies} copies need "
                f"({self.copies}, 3)."
            )
        source = self._noise if noise is None else noise
        if source is None:
            raise ValueError("step was called before reset; reset the environment first.")
        self._steer(wanted)
        fatigue = self._fatigue.step(self._steerings, source)
        self._convolve()
        self._mis_calibration.step(self._steerings[2])
        return self._observe(fatigue, source)

    def _steer(self, wanted: Array) -> None:
        """Equation 3.1."""
        delta, steerings = self._delta, self._steerings
        delta[...] = wanted.T
        np.minimum(delta, self._ones, out=delta)
        np.maximum(delta, self._minus_ones, out=delta)
        delta *= self._step_sizes
        delta += steerings
        np.maximum(delta, self._zeros, out=delta)
        np.minimum(delta, self._hundreds, out=delta)
        # a NaN survives clipping, and a dot product is the cheapest way to see one
        if math.isnan(np.dot(delta.reshape(-1), self._ones.reshape(-1))):
            raise ValueError("actions hold a value that is not a number; the copies did not move.")
        self._steerings, self._delta = delta, steerings

    def _operational_cost(self, into: Array) -> Array:
        """Equation 3.3."""
        cost = self._cost
        np.dot(_COST_RATES, self._steerings, out=cost)
        cost += self._setpoint_cost
        return np.exp(cost, out=into)

    def _convolve(self) -> None:
        """Equation 3.4."""
        self._operational_cost(self._costs[self._oldest])
        self._oldest = (self._oldest + 1) % _COST_STEPS
        np.dot(self._ring_weights[self._oldest], self._costs, out=self._convolved)

    def _observe(self, fatigue: Array, source: NoiseSource) -> tuple[Array, Array]:
        """Equations 3.2, 3.7 and 3.8."""
        columns = np.empty((6, self.copies))  # handed out transposed: no strided writes
        columns[0] = self.setpoint
        columns[1:4] = self._steerings
        columns[4] = fatigue
        exact, spread = columns[5], self._spread
        np.multiply(self._mis_calibration.potential, _PENALTY, out=exact)
        exact += self._convolved
        exact += _PENALTY
        np.multiply(exact, _CONSUMPTION_SPREAD, out=spread)
        spread += _ONE
        spread *= source.consumption()
        exact += spread
        rewards: Array = np.dot(_REWARD_RATES, columns[4:])
        self._columns, self._rewards = columns, rewards
        return columns.T, rewards

    def state(self) -> dict[str, Any]:
        """Copies of all state, visible and hidden, as arrays `[N]`.

        `operational_costs` is `[N, 10]`, oldest first. Beside the frame features and the start
        values of `reset`: `effective_shift`, `effective_gain`, `effective_velocity`, `potential`,
        `basic_fatigue`, `convolved_cost` and `reward`.
        """
        fatigue, mis_calibration = self._fatigue, self._mis_calibration
        latents = np.array([decode_latents(int(i) // 3) for i in mis_calibration.latents])
        visible = dict(zip(FRAME_FEATURES, self._columns.copy(), strict=True))
        return {
            **visible,
            "operational_costs": np.roll(self._costs, -self._oldest, axis=0).T.copy(),
            "hidden_velocity": fatigue.hidden[0].copy(),
            "hidden_gain": fatigue.hidden[1].copy(),
            "domain": latents[:, 0],
            "response": latents[:, 1],
            "direction": latents[:, 2],
            "effective_shift": mis_calibration.shift.copy(),
            "effective_velocity": fatigue.effective[0].copy(),
            "effective_gain": fatigue.effective[1].copy(),
            "potential": mis_calibration.potential.copy(),
            "basic_fatigue": fatigue.basic.copy(),
            "convolved_cost": self._convolved.copy(),
            "reward": self._rewards.copy(),
        }
