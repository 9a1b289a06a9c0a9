"""MuJoCo robots such as Swimmer, Hopper and Walker2D, N independent copies at once.

Observations, rewards and falls are those of Gymnasium's v5 classes, or of the third version that
the thesis used (`specifications.py`), computed for all copies together; the reward is
forward speed + healthy reward - control cost (thesis section 3.2, which prints the forward speed
with the sign reversed).

A copy that has fallen is not simulated any more: its frame stays and its reward is zero until it is
started again. A simulation that becomes unstable counts as fallen; its position is lost, so the
reward of its last step has no forward speed.

Shapes: actions `[N, A]`, frames `[N, F]`, rewards `[N]`.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from components.environments.mujoco.simulations import simulate
from components.environments.mujoco.specifications import Robot, load_model

__all__ = ["Robots"]

Array = NDArray[np.float64]


class Robots:
    """N copies of one robot.

    Args:
        robot: which one.
        copies: number of copies N.
        physics: "v3" as in the thesis, "v5" as in Gymnasium today.
        threads: number of threads that step the copies; the numbers do not depend on it.

    Attributes:
        frame_features: names of the F values of a frame.
        action_features: names of the A values of an action.
        terminated: `[N]` whether a copy has fallen.

    Raises:
        ValueError: a copy or thread count below one, or a physics that does not exist.
    """

    def __init__(self, robot: Robot, copies: int, physics: str = "v3", threads: int = 1) -> None:
        if copies < 1 or threads < 1:
            raise ValueError(f"copies is {copies} and threads is {threads}; give at least 1.")
        self.copies = copies
        self.frame_features = robot.frame_features
        self.action_features = robot.action_features
        self.terminated = np.zeros(copies, dtype=np.bool_)
        self._robot = robot
        self._pays_for_fall = physics == "v3"
        self._model = load_model(robot, physics)
        self._seconds = float(self._model.opt.timestep) * robot.substeps
        self._simulations = simulate(self._model, copies, threads)
        self._started = False

    def reset(self, rng: np.random.Generator | Sequence[np.random.Generator]) -> Array:
        """Start all copies.

        Args:
            rng: generator of the start states, or one for each copy; a copy's start then equals
                that of Gymnasium's environment reset with its generator's seed.

        Returns:
            `[N, F]` the first frame of every copy.

        Raises:
            ValueError: another number of generators than copies.
        """
        self._started = True
        return self.reset_copies(np.ones(self.copies, dtype=np.bool_), rng)

    def reset_copies(
        self,
        copies: NDArray[np.bool_],
        rng: np.random.Generator | Sequence[np.random.Generator],
    ) -> Array:
        """Start some of the copies again while the others stay where they are.

        Args:
            copies: `[N]` mask of the copies to start again.
            rng: as in `reset`; of N generators only those of the masked copies are used.

        Returns:
            `[copies.sum(), F]` their first frames.

        Raises:
            ValueError: another number of generators than copies.
        """
        ids = np.flatnonzero(copies)
        noise = self._start_noise(ids, rng)
        positions = self._model.qpos0 + noise[:, : self._model.nq]
        self._simulations.start(ids, positions, noise[:, self._model.nq :])
        self.terminated = self.terminated & ~copies
        return self._frames()[ids]

    def _start_noise(
        self, ids: NDArray[np.intp], rng: np.random.Generator | Sequence[np.random.Generator]
    ) -> Array:
        """`[M, nq + nv]`; every generator draws a copy's positions, then its velocities."""
        if isinstance(rng, np.random.Generator):
            generators = [rng] * ids.size  # it serves copy after copy
        elif len(rng) == self.copies:
            generators = [rng[copy] for copy in ids]
        else:
            raise ValueError(
                f"{len(rng)} generators were given for {self.copies} copies; give one, or one "
                "for each copy."
            )
        limit, nq, nv = self._robot.reset_noise, self._model.nq, self._model.nv
        noise = np.empty((ids.size, nq + nv))
        for row, generator in zip(noise, generators, strict=True):
            row[:nq] = generator.uniform(-limit, limit, nq)
            if self._robot.normal_velocities:
                row[nq:] = limit * generator.standard_normal(nv)
            else:
                row[nq:] = generator.uniform(-limit, limit, nv)
        return noise

    def step(self, actions: ArrayLike) -> tuple[Array, Array]:
        """Move every copy that stands by one step.

        Args:
            actions: `[N, A]` torques, clipped to [-1, 1].

        Returns:
            The new frames `[N, F]` and the rewards `[N]`; both arrays are the caller's to keep.

        Raises:
            ValueError: a wrong shape, a value that is not a number, or no reset before.
        """
        wanted = np.asarray(actions, dtype=np.float64)
        shape = (self.copies, len(self.action_features))
        if wanted.shape != shape:
            raise ValueError(
                f"actions have the shape {wanted.shape}; {self.copies} copies need {shape}."
            )
        if np.isnan(wanted).any():
            raise ValueError("actions hold a value that is not a number; the copies did not move.")
        if not self._started:
            raise ValueError("step was called before reset; reset the environment first.")
        rewards = np.zeros(self.copies)
        ids = np.flatnonzero(~self.terminated)
        if ids.size:
            rewards[ids] = self._advance(ids, np.clip(wanted[ids], -1.0, 1.0))
        return self._frames(), rewards

    def state(self) -> tuple[Array, Array]:
        """Copies of positions `[N, nq]` and velocities `[N, nv]`, those unseen in frames, too."""
        return self._simulations.positions.copy(), self._simulations.velocities.copy()

    def _advance(self, ids: NDArray[np.intp], torques: Array) -> Array:
        """Simulate the copies that stand, update `terminated`, and return the rewards `[M]`."""
        robot, simulations = self._robot, self._simulations
        before = simulations.positions[ids, 0]
        simulations.advance(ids, torques, robot.substeps)
        positions, velocities = simulations.positions[ids], simulations.velocities[ids]
        failed = simulations.failed[ids]
        standing = np.ones(ids.size, dtype=np.bool_)
        if robot.health is not None:
            standing = robot.health.holds(positions, velocities)
        terminated = self.terminated.copy()
        terminated[ids] = ~standing | failed
        self.terminated = terminated
        speed = (positions[:, 0] - before) / self._seconds
        speed[failed] = 0.0
        healthy = robot.healthy_reward * (standing | self._pays_for_fall)
        cost = robot.control_cost * np.square(torques).sum(axis=1)
        rewards: Array = speed + healthy - cost
        return rewards

    def _frames(self) -> Array:
        """`[N, F]` positions without those in the plane, then clipped velocities."""
        limit = self._robot.velocity_limit
        positions = self._simulations.positions[:, self._robot.unseen_positions :]
        velocities = np.clip(self._simulations.velocities, -limit, limit)
        return np.concatenate([positions, velocities], axis=1)
