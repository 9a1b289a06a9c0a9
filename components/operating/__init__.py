"""One running system in two copies: a policy at an operator's proximity beside the behaviour.

In: a policy, the clone of the behaviour, what is familiar of their log, and a real system or
recorded states. Out: step by step, what both do and what it earns; recordings that replay to the
byte.
"""
