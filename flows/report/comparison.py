"""What of the thesis a sweep's cells can be compared with: the same protocol, or reduced budgets.

The thesis's budgets and protocol are those of the profile "paper". A cell is the aggregation of a
(dataset, algorithm) pair; what it was made with is the configurations of the nodes behind it.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

from components.algorithms import ALGORITHMS
from components.core.options import with_options
from components.data.card import DatasetCard
from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.reporting.thesis_numbers import Thesis, thesis_numbers
from flows.configuration.settings import SettingsError, load_settings
from flows.pipeline.plan import Node
from flows.planning.benchmark import benchmark_plan

__all__ = ["Comparison", "Difference", "comparable_behaviour", "compare"]

_OTHER_DISCOUNT, _REDUCED, _OTHER_LOG = "¹²³"
_PRINTED_WITH: Final = {"ddpg": 0.99}
"""Discounts of rows that the thesis prints with another one, on the Industrial Benchmark."""
_BUDGETS: Final = ("updates", "epochs", "trajectories", "steps", "transitions", "snapshots")
"""Settings of which less means that a cell was made with less work or data."""
_OF_RUNS: Final = ("seed", "seeds", "stream", "dataset", "algorithm")
"""What tells cells and seeds apart; no setting."""


@dataclass(frozen=True)
class Difference:
    """A setting of a cell that is not the thesis's.

    Attributes:
        part: What it belongs to: the algorithm, a model, the log, evaluation; empty: the cell.
        setting: Its name.
        here: Its value.
        thesis: The value in the profile "paper".
    """

    part: str
    setting: str
    here: Any
    thesis: Any

    @property
    def reduces(self) -> bool:
        """Whether it means less work or data than the thesis's."""
        return (
            self.setting in (*_BUDGETS, "seeds")
            and isinstance(self.here, int | float)
            and isinstance(self.thesis, int | float)
            and self.here < self.thesis
        )

    def __str__(self) -> str:
        here, thesis = (f"{v:,}" if isinstance(v, int) else v for v in (self.here, self.thesis))
        return f"{self.part} {here} of {thesis} {self.setting}".strip()


@dataclass(frozen=True)
class Comparison:
    """What can be said of a sweep's cells beside the thesis's.

    Attributes:
        thesis: (dataset, algorithm) -> the thesis's value where the protocol is the thesis's.
        footnotes: Sentences by the marks of these values.
        differences: (dataset, algorithm) -> settings that are not the thesis's.
        notes: Sentences about cells that cannot be compared.
    """

    thesis: Mapping[tuple[str, str], Thesis]
    footnotes: Mapping[str, str]
    differences: Mapping[tuple[str, str], Sequence[Difference]]
    notes: Sequence[str]


def compare(cells: Iterable[Node]) -> Comparison:
    """Compare the cells of a sweep with the thesis's.

    Args:
        cells: Aggregation nodes.
    """
    found = {(c.config["dataset"], c.config["algorithm"]): c for c in cells}
    notes = []
    try:
        paper = _paper(frozenset(d for d, _ in found), frozenset(a for _, a in found))
    except SettingsError as error:
        paper = {}
        notes.append(f"Nothing is compared with the thesis: {error}")
    numbers, thesis, differences, foreign = thesis_numbers(), {}, {}, []
    for pair, cell in found.items():
        if pair not in paper:
            continue
        differences[pair] = list(_differences(cell, paper[pair]))
        if pair not in numbers:
            continue
        ours, printed = _protocol(cell), _printed(paper[pair])
        if ours in (printed, _protocol(paper[pair])):
            discounted = ours != printed
            marks = _OTHER_DISCOUNT if discounted else ""
            marks += _REDUCED if any(d.reduces for d in differences[pair]) else ""
            marks += "" if _industrial(cell) else _OTHER_LOG
            thesis[pair] = Thesis(*numbers[pair], marks, discounted)
        else:
            foreign.append(cell)
    used = "".join(value.marks for value in thesis.values())
    footnotes = {
        _OTHER_DISCOUNT: "discounted with 0.99 in the thesis and with 0.97 here: the same policies "
        "have much lower returns there; evaluation.discount=0.99 shows them.",
        _REDUCED: _reduced(own for pair, own in differences.items() if pair in thesis),
        _OTHER_LOG: "the thesis's robots were logged by other experts: a hint, no comparison.",
    }
    footnotes = {mark: text for mark, text in footnotes.items() if mark in used}
    return Comparison(thesis, footnotes, differences, notes + _foreign_notes(foreign))


def comparable_behaviour(card: DatasetCard, cells: Iterable[Node]) -> float | None:
    """The logged behaviour's return if it is counted as the policies' are; else None.

    Args:
        card: Of a dataset.
        cells: Aggregation nodes of the sweep.
    """
    protocols = [_evaluation(c).config["evaluation"] for c in cells if _dataset(c) == card.name]
    same = all(
        (p["horizon"], p["discount"]) == (card.return_steps, card.discount) for p in protocols
    )
    return card.first_window_return_mean if same else None


def _dataset(cell: Node) -> str:
    return str(cell.config["dataset"])


def _evaluation(cell: Node) -> Node:
    return next(iter(cell.inputs.values()))


@cache
def _paper(datasets: frozenset[str], algorithms: frozenset[str]) -> dict[tuple[str, str], Node]:
    """The cells of the profile "paper", of those that this project has the settings of."""
    everything = load_settings(["profile=paper", "algorithms=all"])
    known = sorted(datasets & set(everything.datasets))
    names = sorted(algorithms & set(everything.algorithms))
    if not known or not names:
        return {}
    seeds = everything.seeds
    words = [f"datasets=[{','.join(known)}]", f"algorithms=[{','.join(names)}]"]
    # One seed is enough: all have the same settings.
    plan = benchmark_plan(load_settings(["profile=paper", *words, f"seeds=[{seeds[0]}]"]))
    cells = plan.by_component().get("aggregation", [])
    return {
        (c.config["dataset"], c.config["algorithm"]): replace(
            c, config={**c.config, "seeds": list(seeds)}
        )
        for c in cells
    }


def _protocol(cell: Node) -> tuple[Any, ...]:
    """What has to be the same for returns to be comparable; the discount is its last part."""
    config = _evaluation(cell).config
    protocol = config["evaluation"]
    system = (config["environment"], dict(config["parameters"]))
    return *system, protocol["horizon"], protocol["discount"]


def _printed(paper: Node) -> tuple[Any, ...]:
    """Likewise, of the number that the thesis prints for a cell of the profile "paper"."""
    *same, discount = _protocol(paper)
    if _industrial(paper):
        discount = _PRINTED_WITH.get(paper.config["algorithm"], discount)
    return *same, discount


def _industrial(cell: Node) -> bool:
    return bool(_evaluation(cell).config["environment"] == INDUSTRIAL_BENCHMARK_ID)


def _differences(cell: Node, paper: Node) -> Iterator[Difference]:
    """Settings of a cell and of what is behind it that the paper profile has otherwise."""
    seeds = [len(node.config["seeds"]) for node in (cell, paper)]
    if seeds[0] != seeds[1]:
        yield Difference("", "seeds", *seeds)
    yield from _unequal("the table", cell.config, paper.config)
    ours, theirs = _evaluation(cell), _evaluation(paper)
    yield from _unequal("evaluation", ours.config["evaluation"], theirs.config["evaluation"])
    ours, theirs = ours.inputs["policy"], theirs.inputs["policy"]
    yield from _unequal("training", ours.config, theirs.config)
    kind = ALGORITHMS[ours.config["algorithm"]].config
    settings = (with_options(kind, node.config["settings"]) for node in (ours, theirs))
    yield from _unequal(ours.config["algorithm"], *settings)
    for role, model in ours.inputs.items():
        other = theirs.inputs.get(role)
        if other is not None and role != "dataset":
            yield from _unequal(role, model.config["settings"], other.config["settings"])
    held_out = [node.inputs["dataset"].config.get("held_out", 0.0) for node in (ours, theirs)]
    if held_out[0] != held_out[1]:
        yield Difference("the log", "share held out for judges", *held_out)
    ours, theirs = _log_of(ours), _log_of(theirs)
    yield from _unequal("the log", ours.config["spec"], theirs.config["spec"])
    if ours.config["seed"] != theirs.config["seed"]:
        yield Difference("the log", "data.seed", ours.config["seed"], theirs.config["seed"])


def _log_of(policy: Node) -> Node:
    """The node that generated a policy's log, of which the policy may have seen a part only."""
    node = policy.inputs["dataset"]
    while node.component != "data_generation":
        node = node.inputs["dataset"]
    return node


def _unequal(part: str, here: Mapping[str, Any], paper: Mapping[str, Any]) -> Iterator[Difference]:
    for name in here.keys() & paper.keys() - set(_OF_RUNS):
        if not isinstance(here[name], Mapping) and here[name] != paper[name]:
            yield Difference(part, name, here[name], paper[name])


def _reduced(differences: Iterable[Sequence[Difference]]) -> str:
    """The sentence about budgets below the thesis's."""
    less = dict.fromkeys(str(d) for own in differences for d in own if d.reduces)
    return f"the thesis's full budgets; here {', '.join(less)}."


def _foreign_notes(cells: Sequence[Node]) -> list[str]:
    """A sentence if cells have another protocol than the thesis's."""
    found = {_protocol(cell)[2:] for cell in cells}
    return [
        f"No value of the thesis stands beside returns of {horizon} steps with the discount "
        f"{discount:g}: its own are not comparable with them."
        for horizon, discount in sorted(found)
    ]
