"""Datasets: controllers, experts, collection, storage, history windows, splits and exchange.

Import from the modules: learners use `dataset`, `history`, `lanes` and `splits`, which know no
environment; `catalogue` and whatever it makes datasets with (`industrial`, `robots`) run
the real systems.
"""
