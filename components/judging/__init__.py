"""Judges: what policies are worth, estimated from a log alone, before any of them acts for real.

In: policies and a part of their log that they have not learned from, with an ensemble and a
behaviour policy fitted to that part. Out: estimates with errors (:mod:`.judgement`). No path leads
from here to a real system.
"""
