"""Hyperparameter search of the supervised models, on held-out trajectories and nothing else.

In: specifications of studies (a model's configuration, what is varied, the node that fits it), a
store, an executor. Out: an Optuna study for each, a record of its trials, the winner's settings as
a file. Nothing here imports environments, evaluation or algorithms, directly or indirectly.
"""
