"""Returns of stored policies on the real system.

In: stacks of policies, the system's id, the protocol. Out: discounted returns of all snapshots and
proximities, and the distances of their actions to the behaviour policy's.
"""
