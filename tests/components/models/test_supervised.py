"""Fitting a stack: schedules, the best state of every lane, stopping, resumption."""

import math
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from components.core.draws import Normal
from components.core.random_streams import LaneStreams
from components.models import supervised
from components.models.supervised import Monitor, StackedFit, ended_at, nothing_learned
from components.training.divergence import DivergedError
from components.training.loop import Curves
from tests.components.interruption import killed_at, lanes, save_always
from tests.components.synthetic import CPU, keys


class Points(nn.Module):
    """Two points of three numbers a lane."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.place = nn.Parameter(torch.arange(count * 2.0)[:, None].repeat(1, 3))


def pulled(network: Points, drawn: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean squared distance to what is drawn, and the mean draw."""
    places = network.place.view(-1, 2, 3)
    wanted = drawn["place"]
    return (places - wanted).square().mean(dim=(1, 2)), {"mean": wanted.mean(dim=(1, 2))}


def fitting(*names: object, **options: Any) -> StackedFit[Points]:
    streams = LaneStreams(keys(*names), {"place": Normal(2, 3)}, CPU)
    settings = {"learning_rate": 0.1} | options
    return StackedFit(Points(len(names)), len(names), pulled, streams, **settings)


def losses_by_turn(*turns: list[float]) -> Any:
    """A validation that returns these after an infinite loss at the start, whatever the network."""
    told = iter([[math.inf] * len(turns[0]), *turns])
    return lambda network: torch.tensor(next(told))


def test_every_lane_keeps_the_state_of_its_lowest_loss() -> None:
    found = fitting("a", "b", "c")
    states: list[Tensor] = []
    turns = iter([[0.0] * 3, [5.0, 1.0, 3.0], [4.0, 2.0, 3.0], [4.5, 0.5, math.nan]])

    def validate(network: Points) -> Tensor:
        states.append(network.place.detach().clone())
        return torch.tensor(next(turns))

    found.run(validate, "abc", updates=6, validate_every=2)
    best = found.best.place
    assert found.best_loss.tolist() == [4.0, 0.5, 3.0]
    assert torch.equal(best[:2], states[2][:2])
    assert torch.equal(best[2:4], states[3][2:4])
    assert torch.equal(best[4:], states[1][4:]), "equal losses and undefined ones are not lower"
    assert torch.equal(found.network.place, states[3])


def test_small_improvements_do_not_count_if_told_so() -> None:
    found = fitting("a", "b")
    turns = losses_by_turn([1.0, 1.0], [0.995, 0.98], [0.991, 0.975], [0.989, 0.971])
    found.run(turns, "ab", updates=4, validate_every=1, improvement=0.01)
    # 0.995 and 0.991 are within 1 % of 1, 0.975 and 0.971 of 0.98
    assert found.best_loss.tolist() == pytest.approx([0.989, 0.98])
    assert found.stale.tolist() == [0.0, 2.0]


def test_training_stops_when_no_lane_has_improved_for_a_while() -> None:
    turns = [[3.0, 3.0], [4.0, 2.0], [4.0, 4.0], [4.0, 4.0], [0.0, 0.0]]
    curves = fitting("a", "b").run(
        losses_by_turn(*turns), "ab", updates=50, validate_every=2, patience=2
    )
    assert curves.of_lane(0)["model/validation_loss"] == ([2, 4, 6, 8], [3.0, 4.0, 4.0, 4.0])
    endless = fitting("a", "b").run(losses_by_turn(*turns), "ab", updates=10, validate_every=2)
    assert endless.of_lane(1)["model/validation_loss"][0] == [2, 4, 6, 8, 10]


def test_the_last_update_is_validated_and_the_monitor_told_of_the_best() -> None:
    told: list[tuple[float, float]] = []
    fractions: list[float] = []
    monitor = Monitor(fractions.append, lambda done, loss: told.append((done, loss)))
    turns = [[3.0, 1.0], [2.0, 4.0], [5.0, 0.0]]
    fitting("a", "b").run(
        losses_by_turn(*turns), "ab", updates=5, validate_every=2, monitor=monitor
    )
    assert told == [(0.4, 2.0), (0.8, 1.5), (1.0, 1.0)]
    assert fractions == [0.4, 0.8, 1.0]
    told.clear()
    fitting("a", "b").run(
        losses_by_turn(*turns),
        "ab",
        updates=5,
        validate_every=2,
        overall=torch.amin,
        monitor=monitor,
    )
    assert told == [(0.4, 1.0), (0.8, 1.0), (1.0, 0.0)]


def test_what_the_monitor_raises_ends_the_fit() -> None:
    class GivenUpError(Exception):
        pass

    def give_up(done: float, loss: float) -> None:
        raise GivenUpError

    found = fitting("a")
    with pytest.raises(GivenUpError):
        found.run(
            losses_by_turn([1.0], [2.0]),
            "a",
            updates=4,
            validate_every=2,
            monitor=Monitor(validated=give_up),
        )


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_rates_by_hand(schedule: str) -> None:
    """Adam's first two steps under a gradient of constant sign are the rates themselves."""
    streams = LaneStreams(keys("a"), {"place": Normal(2, 3)}, CPU)

    def slope(network: Points, drawn: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        return network.place.view(1, 2, 3).sum(dim=(1, 2)), {}

    found = StackedFit(Points(1), 1, slope, streams, learning_rate=0.1, schedule=schedule)
    places: list[Tensor] = []

    def validate(network: Points) -> Tensor:
        places.append(network.place.detach().clone())
        return torch.zeros(1)

    found.run(validate, "a", updates=4, validate_every=1)
    for step, (before, after) in enumerate(pairwise(places)):
        rate = 0.1 if schedule == "constant" else 0.05 * (1.0 + math.cos(math.pi * step / 4))
        # float32, and Adam's epsilon of 1e-8 beside a gradient of 1
        torch.testing.assert_close(before - after, torch.full((2, 3), rate), rtol=1e-4, atol=1e-6)


def test_weight_decay_pulls_towards_zero() -> None:
    ends = []
    for decay in (0.0, 10.0):
        found = fitting("a", weight_decay=decay)
        with torch.no_grad():
            found.network.place.fill_(5.0)
        found.run(lambda network: torch.zeros(1), "a", updates=300, validate_every=300)
        ends.append(float(found.network.place.detach().abs().max()))
    # Without decay the place follows the draws, with it the draws have a fifteenth of the pull.
    assert ends[1] < 0.3 * ends[0]


def test_lanes_learn_as_alone() -> None:
    together, alone = fitting("a", "b"), fitting("b")
    with torch.no_grad():
        alone.network.place.copy_(together.network.place[2:])
    for found, names in ((together, "ab"), (alone, "b")):
        found.run(
            lambda network: network.place.view(-1, 6).square().sum(dim=1),
            names,
            updates=60,
            validate_every=5,
        )
    # sixty Adam updates in float32
    torch.testing.assert_close(together.best.place[2:], alone.best.place, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(together.best_loss[1:], alone.best_loss, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("deaths", [[0], [11], [10, 25], [39]])
def test_interrupted_equals_uninterrupted(
    deaths: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights, best states, moments, the schedule and how long lanes have been stale."""
    save_always(monkeypatch, supervised)

    def run(checkpoint: Path | None) -> tuple[StackedFit[Points], Curves]:
        found = fitting("h", "i", schedule="cosine", learning_rate=1.0)
        curves = found.run(
            lambda network: network.place.view(2, 6).square().sum(dim=1),
            "ab",
            updates=60,
            validate_every=5,
            patience=2,
            checkpoint=checkpoint,
        )
        return found, curves

    expected, curves = run(None)
    found, resumed = killed_at(deaths, StackedFit, run, tmp_path / "c", monkeypatch)
    for name, tensor in expected.state_dict().items():
        assert torch.equal(found.state_dict()[name], tensor), name
    assert lanes(resumed, 2) == lanes(curves, 2)
    last = curves.of_lane(0)["model/validation_loss"][0][-1]
    assert 40 <= last < 60, "it must have stopped early, after the last death"


def test_only_finite_states_of_finite_loss_are_kept() -> None:
    found = fitting("a", "b", "c")
    turns = iter(
        [[9.0] * 3, [math.nan, 3.0, -math.inf], [math.inf, 2.0, 5.0], [math.nan, 1.0, 4.0]]
    )
    kept: list[Tensor] = []

    def validate(network: Points) -> Tensor:
        losses = torch.tensor(next(turns))
        if losses[1] == 1.0:
            network.place[2, 0] = torch.inf  # the second lane's, whose loss does not tell
        kept.append(network.place.detach().clone())
        return losses

    curves = found.run(validate, "abc", updates=3, validate_every=1)
    assert found.best_loss.tolist() == [math.inf, 2.0, 4.0]
    assert torch.equal(found.best.place[2:4], kept[2][2:4])
    assert torch.equal(found.best.place[4:], kept[3][4:])
    assert found.best.place.isfinite().all()
    with pytest.raises(DivergedError, match=r"^its held-out loss was never finite$"):
        ended_at(curves, found.best_loss)
    assert ended_at(curves, found.best_loss, slice(2, 3)) == 1
    assert ended_at(curves, found.best_loss, slice(1, 2)) is None


def test_a_fit_that_stays_finite_has_no_end() -> None:
    found = fitting("a", "b")
    curves = found.run(losses_by_turn([2.0, 1.0], [1.0, 2.0]), "ab", updates=2, validate_every=1)
    assert ended_at(curves, found.best_loss) is None


def test_a_fit_that_never_beats_the_untrained_network_has_learned_nothing(tmp_path: Path) -> None:
    found, losses = fitting("a", "b"), torch.tensor([4.0, 9.0])
    found.run(lambda _: losses, "ab", updates=2, validate_every=1, checkpoint=tmp_path / "c")
    assert nothing_learned(found.best_loss, found.untrained_loss) == {
        "training/untrained_loss": 6.5
    }
    assert nothing_learned(torch.tensor([3.9, 8.9]), found.untrained_loss) == {}
    assert nothing_learned(torch.tensor([3.9]), torch.tensor([math.nan])) == {}


def test_the_untrained_network_is_that_before_the_checkpoint(tmp_path: Path) -> None:
    def run() -> StackedFit[Points]:
        found = fitting("a", learning_rate=1.0)
        found.run(
            lambda network: network.place.square().sum()[None],
            "a",
            updates=3,
            validate_every=1,
            checkpoint=tmp_path / "c",
        )
        return found

    first, again = run(), run()
    assert first.untrained_loss.tolist() == again.untrained_loss.tolist() == [3.0]
    assert again.best_loss.item() != 3.0
