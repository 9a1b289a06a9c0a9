"""The real systems. Importing this package registers them with Gymnasium.

`gymnasium.make("proximity/IndustrialBenchmark-v0", setpoint=70.0)` gives one machine,
`gymnasium.make_vec` the vectorised one; `gymnasium.make("proximity/Hopper-v0", physics="v3")` gives
one robot.
"""

import gymnasium as gym

__all__ = ["HOPPER_ID", "INDUSTRIAL_BENCHMARK_ID", "SWIMMER_ID", "WALKER2D_ID"]

INDUSTRIAL_BENCHMARK_ID = "proximity/IndustrialBenchmark-v0"
"""Gymnasium id of the Industrial Benchmark, single and vectorised."""
SWIMMER_ID = "proximity/Swimmer-v0"
HOPPER_ID = "proximity/Hopper-v0"
WALKER2D_ID = "proximity/Walker2d-v0"
"""Gymnasium ids of the robots."""

if INDUSTRIAL_BENCHMARK_ID not in gym.registry:
    gym.register(
        id=INDUSTRIAL_BENCHMARK_ID,
        entry_point="components.environments.industrial.gymnasium_api:IndustrialBenchmarkEnv",
        vector_entry_point="components.environments.industrial.gymnasium_api:IndustrialBenchmarkVectorEnv",
        max_episode_steps=1000,
    )
    for _robot, _class in (
        (SWIMMER_ID, "SwimmerRobot"),
        (HOPPER_ID, "HopperRobot"),
        (WALKER2D_ID, "Walker2dRobot"),
    ):
        gym.register(
            id=_robot,
            entry_point=f"components.environments.mujoco.gymnasium_api:{_class}",
            max_episode_steps=1000,
        )
