"""Make the result tables of README.md and docs/: ``python -m docs.result_tables``.

The numbers come from docs/results/ and from the thesis's tables in the package. A table stands
between two comments, ``<!-- table NAME -->`` and ``<!-- end of NAME -->``; what was there is
replaced. A test holds the pages against the data. `pages` lists the pages and the tables; a new
table is a function of the module of its family, named there.
"""
