"""Training of the controllers of the robot datasets: DDPG on the real system, and its choice.

In: settings, random streams and a maker of robots. Out: the best policy of every seed, with its
learning curves. This is data generation, not offline learning: an expert interacts with the real
system and is evaluated on it, and learners see nothing of it but the data that it logs
(:mod:`components.data.controllers.trained` has the experts as they ship).
"""
