"""What a computer must have at least: memory of every task call, and disk for what is kept.

Lower bounds from the settings alone: less than this is impossible, more may well be needed. Counted
are the weights of the widest network with gradient and two moments, one batch as it leaves the
widest layer, the same of the critics of all policies that are judged together, the observations of
all evaluated trajectories, and the arrays of a generated log; on the disk these arrays, a policy's
weights per snapshot and a model's per member.
"""

import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import torch

from components.algorithms import ALGORITHMS
from components.environments.frame_history import HISTORY_LENGTH
from components.environments.industrial.benchmark import FRAME_FEATURES, STEERINGS
from components.environments.mujoco.specifications import ROBOTS
from components.environments.world.plane import COORDINATES, STEPS
from components.evaluation.protocol import EvaluationProtocol
from components.judging.config import JudgeConfig
from flows.configuration.settings import SettingsError
from flows.pipeline.plan import Node
from flows.pipeline.schedule import Group

__all__ = ["check_capacity", "least_bytes", "least_stored", "needs", "total_memory"]

_FLOAT: Final = 4  # bytes
_COPIES: Final = 4  # of a weight: itself, its gradient, Adam's two moments
_SIZES: Final = ("trajectories", "steps", "transitions", "batch", "members", "replicas", "horizon")
"""Settings that messages name, with the widths of layers."""


def total_memory(device: str) -> int:
    """Bytes of memory of this computer, or of its GPU where that has more."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if device != "cuda":
        return memory
    return max(memory, torch.cuda.get_device_properties(0).total_memory)


def check_capacity(groups: Iterable[Group], memory: int, store: Path) -> None:
    """Refuse work that this computer cannot hold.

    Args:
        groups: The task calls that are still to do.
        memory: Bytes of memory.
        store: Where datasets are written; it need not exist.

    Raises:
        SettingsError: Names the first call that needs more memory than there is, or the disk.
    """
    free, stored = _free(store), 0
    for group in groups:
        needed = least_bytes(group.nodes)
        if needed > memory:
            raise SettingsError(
                f"{group.nodes[0].name} needs at least {_size(needed)} of memory "
                f"({_why(group.nodes)}) and this computer has {_size(memory)}; lower these "
                f"settings{_fewer(group.nodes)}."
            )
        stored += sum(least_stored(node) for node in group.nodes)
    if stored > free:
        raise SettingsError(
            f"What is still to be made takes at least {_size(stored)} and the disk of {store} has "
            f"{_size(free)} left; free space, make less data or keep fewer snapshots."
        )


def needs(groups: Sequence[Group], memory: int, store: Path) -> str:
    """What the task calls that are still to do need at least, beside what there is, in a sentence.

    Args:
        groups: These calls.
        memory: Bytes of memory.
        store: Where results are kept; it need not exist.
    """
    stored = sum(least_stored(node) for group in groups for node in group.nodes)
    largest = max(groups, key=lambda group: least_bytes(group.nodes))
    return (
        f"Disk: at least {_size(stored)} needed, {_size(_free(store))} free. Memory of a task: at "
        f"least {_size(least_bytes(largest.nodes))} for {largest.nodes[0].name}, the largest, of "
        f"{_size(memory)}."
    )


def _free(store: Path) -> int:
    """Bytes that are left on the disk of a folder, which need not exist."""
    return shutil.disk_usage(next(p for p in (store, *store.parents) if p.exists())).free


def _size(count: int) -> str:
    """Bytes as text."""
    return f"{count / 2**30:,.0f} GiB" if count >= 2**30 else f"{count / 2**20:,.1f} MiB"


def least_bytes(nodes: Sequence[Node]) -> int:
    """Bytes that the nodes of one task call need at least."""
    first = nodes[0]
    if first.component == "data_generation":
        return _log_bytes(first.config["spec"])
    if first.component in ("policy_training", "model_fitting"):
        return len(nodes) * _training_bytes(first)
    if first.component == "evaluation":
        return len(nodes) * _evaluation_bytes(first)
    if first.component == "judgement":
        return sum(map(_judgement_bytes, nodes))
    return 0


def least_stored(node: Node) -> int:
    """Bytes of disk that the artifact of a node takes at least."""
    if node.component == "data_generation":
        return _log_bytes(node.config["spec"])
    if node.component in ("policy_training", "model_fitting"):
        kept = node.config.get("snapshots", 1) * node.config["settings"].get("members", 1)
        return int(kept * _FLOAT * min(_weights(node), default=0))
    return 0


def _spec(data: Node) -> Mapping[str, Any]:
    """What a dataset is made by; that of a part is the whole log's."""
    spec: Mapping[str, Any] = (data.inputs.get("dataset") or data).config["spec"]
    return spec


def _shape(spec: Mapping[str, Any]) -> tuple[int, int, int]:
    """Frames in an observation, values of a frame and of an action; 1 where they are not known."""
    if spec.get("robot") in ROBOTS:
        robot = ROBOTS[spec["robot"]]
        return 1, len(robot.frame_features), len(robot.action_features)
    if "goals" in spec:
        return 1, len(COORDINATES), len(STEPS)
    return (
        (HISTORY_LENGTH, len(FRAME_FEATURES), len(STEERINGS)) if "setpoint" in spec else (1, 1, 1)
    )


def _log_bytes(spec: Mapping[str, Any]) -> int:
    """The arrays of a log; a stored one is there already."""
    if "log" in spec:
        return 0
    _, frame, action = _shape(spec)
    if "goals" in spec:
        transitions = spec["episodes"] * spec["length"]
    else:
        transitions = spec.get("transitions", spec.get("trajectories", 1) * spec["steps"])
    return int(transitions * (frame + action + 1) * _FLOAT)


def _networks(settings: Mapping[str, Any]) -> list[list[int]]:
    """Widths of the hidden layers of every network."""
    named = [value for name, value in settings.items() if name.endswith("hidden")]
    return [value if isinstance(value, list) else [value, value] for value in named if value]


def _training_bytes(node: Node) -> int:
    """One lane: the widest network's weights, and one batch behind its widest layer."""
    settings = node.config["settings"]
    weights = max(_weights(node), default=0)
    widest = max((width for hidden in _networks(settings) for width in hidden), default=1)
    batch = max(settings.get("batch", 1), settings.get("trajectories", 1))
    members = settings.get("members", 1)
    return int(members * weights * _FLOAT * _COPIES + batch * widest * _FLOAT)


def _weights(node: Node) -> list[int]:
    """Of every network, at least."""
    history, frame, _ = _shape(_spec(node.inputs["dataset"]))
    # Models may read less than a whole observation.
    inputs = history * frame if node.component == "policy_training" else frame
    networks = _networks(node.config["settings"])
    return [_between([inputs, *hidden, 1]) for hidden in networks]


def _between(widths: Sequence[int]) -> int:
    """Weights between layers of these widths."""
    return sum(a * b for a, b in pairwise(widths))


def _evaluation_bytes(node: Node) -> int:
    """The observations of all copies of the system."""
    policy = node.inputs["policy"]
    history, frame, _ = _shape(_spec(policy.inputs["dataset"]))
    protocol, _ = EvaluationProtocol.of_record(node.config["evaluation"])
    proximities = len(protocol.proximities) if _takes_proximity(policy) else 1
    copies = policy.config["snapshots"] * proximities * protocol.trajectories
    return int(copies * history * frame * _FLOAT)


def _judgement_bytes(node: Node) -> int:
    """The critics of a run's judged policies, and of each a batch behind its widest layer."""
    config, policy = JudgeConfig(**node.config["estimates"]), node.inputs["policy"]
    history, frame, action = _shape(_spec(policy.inputs["dataset"]))
    proximities = len(config.proximities) if _takes_proximity(policy) else 1
    critics = node.config["snapshots"] * proximities * config.replicas
    weights = _between([history * frame + action, *config.hidden, 1])
    return int(critics * (weights * _COPIES + config.batch * max(config.hidden)) * _FLOAT)


def _takes_proximity(policy: Node) -> bool:
    return ALGORITHMS[policy.config["algorithm"]].takes_proximity


def _fewer(nodes: Sequence[Node]) -> str:
    """How less could be computed in one task call; all policies of a log are judged together."""
    if len(nodes) == 1:
        return ""
    judged = nodes[0].component == "judgement"
    return f" or {'judge fewer seeds or algorithms' if judged else 'compute fewer at once (pack)'}"


def _why(nodes: Sequence[Node]) -> str:
    """The settings behind the memory of a task call."""
    config = nodes[0].config
    groups: Sequence[Mapping[str, Any]] = [
        config[name] for name in ("spec", "settings", "evaluation", "estimates") if name in config
    ]
    named = [
        f"{name}={value}".replace(" ", "")
        for group in groups
        for name, value in group.items()
        if name in _SIZES or name.endswith("hidden")
    ]
    return ", ".join([*named, *([f"{len(nodes)} at once"] if len(nodes) > 1 else [])])
