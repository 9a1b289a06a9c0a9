"""The doors: ``python -m flows.NAME``. Wiring only; the science is in ``components``.

In: settings of ``conf/`` and the command line. Out: a store of artifacts, their record, reports.
Between them: ``configuration`` reads settings, ``planning`` makes plans of them, ``pipeline``
computes plans with the functions of ``tasks``, ``report`` shows the results; ``tuning`` searches
settings of models.

Every door and every worker imports this package before anything heavy. The import sets what native
libraries read once: one thread per process unless a task asks for more (two processes with
two spinning OpenMP threads each on two cores run a hundred times slower than one), and no
telemetry.
"""

import os

for _name, _value in {
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "RAY_USAGE_STATS_ENABLED": "0",
}.items():
    os.environ.setdefault(_name, _value)
