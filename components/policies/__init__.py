"""Policies as they are stored and deployed; training them is elsewhere.

In: trained networks of several lanes, and a card that says how they act. Out: a folder of two
files, and actions for raw frames.
"""
