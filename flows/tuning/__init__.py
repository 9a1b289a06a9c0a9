"""Hyperparameter search of the supervised models, on held-out trajectories and nothing else.

Nothing here, nor anything it imports, knows environments, evaluation or algorithms.
"""
