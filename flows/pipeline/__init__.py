"""The engine: computes plans of nodes, resumes them after a kill, and records them in a tracker.

In: a plan whose nodes name task functions, a store, an executor and a tracker. Out: one artifact
folder per node, named by its key. It imports nothing else of `flows` and knows no algorithm.
"""
