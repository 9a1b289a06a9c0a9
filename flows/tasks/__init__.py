"""What runs inside a worker: task functions, one module per component of the benchmark.

In: jobs, each with a configuration, the folders of its inputs and an empty one to fill.
Out: the filled folder, which the pipeline makes an artifact. The science is in `components`.
"""
