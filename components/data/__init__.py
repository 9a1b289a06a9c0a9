"""Datasets: how they are made, how they are stored, and how learners read them.

In: the sources that conf/dataset names (`sources/`, with the `controllers/` that act in them) or
logs of other tools. Out: stored datasets with a card (`dataset`, `dynamics`), and lane-first
batches and histories of these on a device (`batches`, `frame_table`). `indicators` and `advice` say
what a log promises before anything is learned from it.

Import from the modules: learners use those that import no environment; `sources/` runs the real
systems.
"""
