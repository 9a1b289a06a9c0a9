"""One-step transition models: ensembles of multilayer perceptrons, deterministic or Gaussian.

In comes a dataset whose card tells what is known of its dynamics; out goes an ensemble that
predicts the learned features of the next frame from a history and the known ones.
"""
