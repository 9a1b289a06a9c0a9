"""Transition models with a hidden state: ensembles of recurrent networks.

In: windows of a dataset's model frames. Out: an ensemble that predicts the learned features step by
step; its hidden state holds the information of earlier frames.
"""
