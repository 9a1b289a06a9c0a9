"""The report of a sweep: its table, its figures, and the commands that film its policies.

In: the plan of a sweep and the store with its finished nodes. Out: the folder
``STORE/reports/SWEEP``, with the keys of the nodes behind it, and the sweep's headline metrics.
"""
