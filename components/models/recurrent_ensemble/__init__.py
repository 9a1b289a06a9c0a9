"""Transition models that remember: ensembles of recurrent networks.

In come windows of a dataset's model frames; out goes an ensemble that predicts the learned features
step by step, with a hidden state in which all it has been shown before is kept.
"""
