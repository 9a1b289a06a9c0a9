"""Datasets: controllers, collection, storage, history windows, splits and exchange.

Import from the modules: learners use `dataset`, `history` and `splits`, which know no environment;
`collection` and `catalogue` run the real system.
"""
