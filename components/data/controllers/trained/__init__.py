"""The controllers of the robot datasets as they ship, one folder per robot, and their loader.

In comes a folder of two small files and a card, which :mod:`components.experts` makes; out comes an
expert that acts on frames.
"""
