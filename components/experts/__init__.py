"""Training of the controllers of the robot datasets: DDPG on the real system, and its choice.

This is data generation, not offline learning: an expert interacts with the real system, is judged
on it during training, and the best of several seeds is kept. Nothing of it reaches a learner but
the data that an expert logs (:mod:`components.data.controllers.trained`).

- `replay`: transitions of all lanes on the device and, as they happen, in files.
- `online`: the learner that acts, remembers and updates.
- `judging`: whole episodes of a policy, rewards after a fall being 0.
- `training`: budget, checkpoints, evaluation on the way, the best policy of every seed.
"""
