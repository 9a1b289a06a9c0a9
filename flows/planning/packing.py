"""Which nodes are computed together, as lanes of one program.

Packing changes no key and no result: every node keeps its artifact, its run and its place in a
checkpoint, and a sweep that goes on with another packing takes what the former has begun.
"""

import torch

from flows.configuration.schema import Settings

__all__ = ["chosen_device", "evaluated_together", "trained_together"]


def chosen_device(settings: Settings) -> str:
    """Where tasks run, "cpu" or "cuda": as `runner.device` says, or where there is a GPU, there.

    Raises:
        ValueError: There is no such device here.
    """
    device = settings.runner.device
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("runner.device=cuda, but PyTorch finds no GPU here; use cpu or auto.")
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return device


def trained_together(settings: Settings, program: str, dataset: str, seed: int) -> str:
    """What policies that are trained in one program have in common, see `runner.pack`.

    A GPU is idle with a few lanes, and takes all that fit; on a processor more than a pair's seeds
    gain little, and results come later.

    Args:
        settings: What is wanted.
        program: What lanes of one program have in common at least: learner, settings and shapes.
        dataset: Of the policy.
        seed: Of the policy.
    """
    match _packing(settings):
        case "none":
            return f"{program}/{dataset}/{seed}"
        case "pair":
            return f"{program}/{dataset}"
        case "algorithm":
            return program
        case number:
            return f"{program}/{settings.datasets.index(dataset) // int(number)}"


def evaluated_together(settings: Settings, label: str, dataset: str, seed: int) -> str:
    """Likewise for evaluations: those of a pair, or each by itself as soon as it can be."""
    pair = f"evaluate/{label}/{dataset}"
    return f"{pair}/{seed}" if _packing(settings) == "none" else pair


def _packing(settings: Settings) -> str | int:
    pack = settings.runner.pack
    if pack == "auto":
        return "algorithm" if chosen_device(settings) == "cuda" else "pair"
    return pack
