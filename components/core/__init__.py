"""Foundations that every other room uses: random streams, the normaliser of features, files.

In: names of lanes, arrays, paths. Out: random generators, scaled features, and files that appear
complete or not at all; a file that cannot be read ends in one sentence with the remedy.
"""
