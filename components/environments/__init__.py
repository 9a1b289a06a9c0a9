"""The real systems. Importing this package registers them with Gymnasium.

`gymnasium.make("proximity/IndustrialBenchmark-v0", setpoint=70.0)` gives one machine,
`gymnasium.make_vec` the vectorised one.
"""

import gymnasium as gym

__all__ = ["INDUSTRIAL_BENCHMARK_ID"]

INDUSTRIAL_BENCHMARK_ID = "proximity/IndustrialBenchmark-v0"
"""Gymnasium id of the Industrial Benchmark, single and vectorised."""

if INDUSTRIAL_BENCHMARK_ID not in gym.registry:
    gym.register(
        id=INDUSTRIAL_BENCHMARK_ID,
        entry_point="components.environments.gymnasium_api:IndustrialBenchmarkEnv",
        vector_entry_point="components.environments.gymnasium_api:IndustrialBenchmarkVectorEnv",
        max_episode_steps=1000,
    )
