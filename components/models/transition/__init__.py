"""The model environment: the one place where virtual trajectories are made.

In come fitted ensembles (:mod:`.interface` says what one must do), states of a log and a policy;
out come the steps that the policy takes in them, one after the other (:mod:`.model_environment`).
"""
