"""Statistics of many policies' returns, the numbers of the result table.

In: returns of all seeds and snapshots. Out: percentile, standard error and means of their pool.
"""
