"""Hyperparameter search of the supervised models, on held-out trajectories and nothing else.

In: subjects (a model's configuration, what is varied, the node that fits it), a store, an executor.
Out: an Optuna study per subject, a record of its trials, and the winner's settings as a file.
Nothing here, nor anything it imports, knows environments, evaluation or algorithms.
"""
