"""The science of the benchmark: data, models, algorithms, evaluation. Typed and free of Ray.

In: logged data or a system to log, settings as frozen dataclasses, random stream keys. Out:
datasets, fitted models, policies, returns and tables, which `flows` plans, runs and stores.
"""
