"""The library: from a log to a policy in ten lines, without a sweep.

    import proximity_bench as pb

    log = pb.dataset("mediocre-0.2")
    policy = pb.train(log, "lion", updates=200)
    action = policy.act(history, proximity=0.3)

It is a package of its own, called as the project is, because it is what programs of others import:
`components` may move its modules about, `flows` are doors of a command line. There is no second
implementation behind it: a policy is the one that a sweep trains from the same log, settings and
seed, number for number where PyTorch uses as many threads and the same device. Ray, MLflow and
Hydra are not needed, and not imported.

In: names of conf/dataset, folders, DataFrames, files. Out: `Policy` objects that act on plain
arrays. Whatever is wrong is a ValueError of one sentence.
"""

from components.data.dataset import OfflineDataset
from components.evaluation.autopilot import Autopilot, AutopilotConfig
from proximity_bench.datasets import dataset
from proximity_bench.flying import autopilot
from proximity_bench.judging import judge, split
from proximity_bench.operating import operate, trajectory
from proximity_bench.policies import Policy
from proximity_bench.ranking import rank
from proximity_bench.stored import load
from proximity_bench.training import train

__all__ = [
    "Autopilot",
    "AutopilotConfig",
    "OfflineDataset",
    "Policy",
    "autopilot",
    "dataset",
    "judge",
    "load",
    "operate",
    "rank",
    "split",
    "train",
    "trajectory",
]
