"""What several algorithms share: records and inputs of learners, their training, parts of methods.

In come lanes' datasets, fitted models and random streams; out go trained policies, one snapshot
after the other, with their learning curves.
"""
