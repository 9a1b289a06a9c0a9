"""N simulations of one MuJoCo model in lock-step.

Where MuJoCo offers it (since 3.17) they are one `mujoco.batch.Batch`, stepped on a thread pool
without the interpreter; else one `MjData` each, stepped in turn. Both give the same numbers, bit by
bit.

Shapes: positions `[N, nq]`, velocities `[N, nv]`; `ids` `[M]` are the simulations a call concerns.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from components.environments.mujoco.engine import mujoco

try:
    from mujoco import batch as mujoco_batch
except ImportError:  # MuJoCo before 3.17
    mujoco_batch = None

__all__ = ["BatchedSimulations", "LoopedSimulations", "Simulations", "simulate"]

Array = NDArray[np.float64]
Ids = NDArray[np.intp]

_FAILURES = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]


class Simulations(Protocol):
    """The interface of N simulations."""

    @property
    def positions(self) -> Array:
        """`[N, nq]`, which the next call may change."""

    @property
    def velocities(self) -> Array:
        """`[N, nv]`, which the next call may change."""

    @property
    def failed(self) -> NDArray[np.bool_]:
        """`[N]` which have become unstable since their start.

        MuJoCo puts such a simulation back to the model's default state, with a warning.
        """

    def start(self, ids: Ids, positions: Array, velocities: Array) -> None:
        """Start some of them from the given state `[M, nq]`, `[M, nv]`."""

    def advance(self, ids: Ids, controls: Array, substeps: int) -> None:
        """Step some of them several times under constant controls `[M, nu]`."""


class BatchedSimulations:
    """Simulations in one `mujoco.batch.Batch`.

    Args:
        model: of all of them.
        copies: N.
        threads: number of threads that step them.
    """

    def __init__(self, model: mujoco.MjModel, copies: int, threads: int) -> None:
        self._batch = mujoco_batch.Batch(model, copies, threads)
        self.positions: Array = self._batch.bind("qpos")
        self.velocities: Array = self._batch.bind("qvel")
        self._controls: Array = self._batch.bind("ctrl")

    @property
    def failed(self) -> NDArray[np.bool_]:
        """`[N]` which have become unstable since their start."""
        failed: NDArray[np.bool_] = self._batch.warning[:, _FAILURES, 1].any(axis=1)
        return failed

    def start(self, ids: Ids, positions: Array, velocities: Array) -> None:
        """Start some of them from the given state."""
        self._batch.reset(ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self.positions[ids], self.velocities[ids] = positions, velocities
        self._batch.forward(ids)

    def advance(self, ids: Ids, controls: Array, substeps: int) -> None:
        """Step some of them several times under constant controls."""
        self._controls[ids] = controls
        self._batch.step(ids, substeps)


class LoopedSimulations:
    """Simulations with an `MjData` each, stepped in turn.

    Args:
        model: of all of them.
        copies: N.
    """

    def __init__(self, model: mujoco.MjModel, copies: int) -> None:
        self._model = model
        self._data = [mujoco.MjData(model) for _ in range(copies)]
        self.positions = np.empty((copies, model.nq))
        self.velocities = np.empty((copies, model.nv))
        self.failed = np.zeros(copies, dtype=np.bool_)

    def start(self, ids: Ids, positions: Array, velocities: Array) -> None:
        """Start some of them from the given state."""
        for i, position, velocity in zip(ids, positions, velocities, strict=True):
            data = self._data[i]
            mujoco.mj_resetData(self._model, data)
            data.qpos[:], data.qvel[:] = position, velocity
            mujoco.mj_forward(self._model, data)
            self._read(i)

    def advance(self, ids: Ids, controls: Array, substeps: int) -> None:
        """Step some of them several times under constant controls."""
        for i, control in zip(ids, controls, strict=True):
            data = self._data[i]
            data.ctrl[:] = control
            mujoco.mj_step(self._model, data, nstep=substeps)
            self._read(i)

    def _read(self, i: int) -> None:
        data = self._data[i]
        self.positions[i], self.velocities[i] = data.qpos, data.qvel
        self.failed[i] = data.warning.number[_FAILURES].any()


def simulate(model: mujoco.MjModel, copies: int, threads: int) -> Simulations:
    """N simulations, in the fastest way this MuJoCo has; threads serve the batch only."""
    if mujoco_batch is None:
        return LoopedSimulations(model, copies)
    return BatchedSimulations(model, copies, threads)
