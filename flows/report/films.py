"""Command lines of `flows.render` that film the policies of a sweep."""

from collections.abc import Collection, Iterable

from components.algorithms import ALGORITHMS
from flows.pipeline.plan import Node

__all__ = ["film_command", "film_notes"]


def film_command(run: str, name: str, takes_proximity: bool) -> str:
    """The command line that films a run into a file of the given name."""
    words = [f"run={run}", f"out={name.replace('/', '-')}.mp4"]
    if takes_proximity:
        words.append("proximity=0.5")
    return " ".join(["python -m flows.render", *words])


def film_notes(done: Iterable[Node], drawable: Collection[str]) -> list[str]:
    """A sentence per algorithm and dataset: how to watch its first seed.

    Args:
        done: Finished nodes of a sweep.
        drawable: Names of the datasets whose system can be drawn.
    """
    commands: dict[str, str] = {}
    for node in done:
        if node.component != "policy_training" or node.tags["dataset"] not in drawable:
            continue
        name = node.name.rpartition("/")[0]
        takes_proximity = ALGORITHMS[node.config["algorithm"]].takes_proximity
        # By the key, since nodes of other sweeps may have the same name.
        commands.setdefault(name, film_command(node.key, name, takes_proximity))
    return [f"To watch {name}: `{command}`" for name, command in commands.items()]
