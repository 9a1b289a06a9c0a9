"""One-step transition models: ensembles of multilayer perceptrons, deterministic or Gaussian.

In: a dataset whose card has a dynamics specification. Out: an ensemble that predicts the learned
features of the next model frame from a history and the known features.
"""
