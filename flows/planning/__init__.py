"""Plans: graphs of nodes, each with everything that decides its result, and a rough cost.

In: `Settings`, and the settings that a search has found. Out: the plans of the benchmark, of its
datasets alone, of expert training and of searches, which :mod:`flows.pipeline` computes.
"""
