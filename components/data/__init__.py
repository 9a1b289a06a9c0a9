"""Logs: what they are, where they come from, and how learners read them.

In come the sources that conf/dataset names (`sources/`, with the `controllers/` that log them) or
logs of other tools; out come stored datasets with a card (`dataset`, `dynamics`), and from these
lane-first batches and histories on a device (`batches`, `frame_table`).

Import from the modules: learners use those that know no environment; `sources/` runs the real
systems.
"""
