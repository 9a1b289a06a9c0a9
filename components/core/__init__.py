"""What every other room stands on: random streams, the normaliser of features, files.

In: names of lanes, arrays, paths. Out: their random numbers, scaled features, and files that
appear whole or not at all, each read back or refused in one sentence.
"""
