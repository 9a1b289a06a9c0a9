"""The controllers of the robot datasets as they ship, one folder per robot, and their loader.

They are made by :mod:`components.experts`.
"""
