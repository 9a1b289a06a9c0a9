"""What a sweep is doing, told from its store alone, also while it runs and from another machine.

In: the record of a sweep with its plan, what its driver tells, finished nodes, progress reports.
Out: text for a terminal, or JSON. Nothing is imported that takes long, and nothing is written.
"""
