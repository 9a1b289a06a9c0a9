"""The model environment: the one place where virtual trajectories are made.

In: fitted ensembles with the interface of :mod:`.interface`, logged start states and a policy. Out:
the steps of the policy in the ensembles, one after the other (:mod:`.model_environment`).
"""
