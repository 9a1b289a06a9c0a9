"""Sources of datasets: the Industrial Benchmark, robots, or a log that is stored already.

In: the fields of a file of conf/dataset and a seed. Out: a dataset with its card. Every kind is a
`DatasetSource` (:mod:`.source`); policies learned from a source without a system are judged from
the log alone.
"""
