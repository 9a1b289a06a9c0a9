"""From the returns of many policies to the statistics of a table.

In: returns of all seeds and snapshots. Out: percentile, standard error, means of their pool.
"""
