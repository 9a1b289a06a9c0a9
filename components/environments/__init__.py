"""The real systems, behind one registry (:mod:`.systems`).

In: actions. Out: frames and rewards, of many copies at once (`make_batch`) or of a single system
behind Gymnasium's interface, and pictures (:mod:`.rendering`). Only data generation, experts and
evaluation import this package.

Importing this package registers the systems with Gymnasium:
`gymnasium.make("proximity/IndustrialBenchmark-v0", setpoint=70.0)` gives one machine,
`gymnasium.make_vec` the vectorised one; `gymnasium.make("proximity/Hopper-v0", physics="v3")` gives
one robot.
"""

import gymnasium as gym

from components.environments.systems import INDUSTRIAL_BENCHMARK, SYSTEMS

__all__ = ["INDUSTRIAL_BENCHMARK_ID"]

INDUSTRIAL_BENCHMARK_ID = INDUSTRIAL_BENCHMARK.id
"""Gymnasium id of the Industrial Benchmark, single and vectorised."""

for _system in SYSTEMS.values():
    if _system.id not in gym.registry:
        gym.register(
            id=_system.id,
            entry_point=_system.entry_point,
            vector_entry_point=_system.vector_entry_point,
            max_episode_steps=1000,
        )
