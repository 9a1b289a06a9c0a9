"""Experts, the controllers of the robot datasets: online training by DDPG on the real system.

In: settings, random streams and a maker of robots. Out: the best policy of every seed, with its
learning curves. This is data generation, not offline learning: an expert interacts with the real
system and is evaluated on it, while learners use only the data that it logs
(:mod:`components.data.controllers.trained` has the experts as they ship).
"""
