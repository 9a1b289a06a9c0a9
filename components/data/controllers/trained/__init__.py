"""The shipped controllers (experts) of the robot datasets, one folder per robot, and their loader.

In: a folder of two small files and a card, which :mod:`components.experts` makes. Out: an expert
that acts on frames.
"""
