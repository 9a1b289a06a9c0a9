"""Trackers: records of sweeps for people; the artifact store needs none of them.

In: the settings of a sweep, its finished and failed nodes, its report. Out: runs in MLflow
(`mlflow_tracker`), lines in a file (`file_tracker`) or nothing (`NullTracker`).
`tracker` is the interface. What a killed process did not record is recorded by the next one.
"""
