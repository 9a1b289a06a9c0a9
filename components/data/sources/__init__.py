"""Where datasets come from: the Industrial Benchmark, robots, or a log that is stored already.

In come the fields of a file of conf/dataset and a seed; out comes a dataset with its card. Every
kind is a `DatasetSource` (:mod:`.source`); one without a system is learned from and not judged.
"""
