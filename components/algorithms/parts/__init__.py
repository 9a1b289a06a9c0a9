"""Code shared by several algorithms: records and inputs of learners, training, parts of methods.

In: lanes' datasets, fitted models and random streams. Out: trained policies, one snapshot after the
other, with their learning curves.
"""
