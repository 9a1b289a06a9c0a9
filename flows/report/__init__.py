"""What people look at when a sweep has ended: its table, its figures and its films' commands.

In: the plan of a sweep and the store with its finished nodes. Out: the folder
``STORE/reports/SWEEP`` and the sweep's headline metrics.
"""
