"""Training of models and policies alike: the loop, states for checkpoints, CUDA graphs.

In: a learner (one update, its state) and a budget. Out: the trained learner and its learning
curves; interruptions do not change them.
"""
