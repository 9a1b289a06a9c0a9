"""Sources of datasets: the Industrial Benchmark, robots, the 2-D world, or a stored log.

In: the fields of a file of conf/dataset and a seed. Out: a dataset with its card. Every kind is a
`DatasetSource` (:mod:`.source`); policies learned from a source without a system are judged from
the log alone.
"""
