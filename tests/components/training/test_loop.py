"""The training loop on a learner that counts: interruption and saving have no influence."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import torch
from torch import Tensor

from components.core.integrity import DamagedFileError
from components.core.tensors import load_tensors, save_tensors
from components.training.loop import Curves, TrainingLoop
from components.training.sums import MetricSums

NAMES = ("a", "b", "c")
DIGITS = {"a": 1.0, "b": 2.0, "c": 3.0}


class Counter:
    """Adds a lane's digit and the step number; sometimes dies before it does."""

    def __init__(self, names: Sequence[str] = NAMES, dies_at: int | None = None) -> None:
        self.digits = torch.tensor([DIGITS[name] for name in names])
        self.total = torch.zeros(len(names))
        self.lanes, self.dies_at, self.updates = len(names), dies_at, 0

    def update(self, step: int) -> dict[str, Tensor]:
        if step == self.dies_at:
            raise RuntimeError("killed")
        self.updates += 1
        self.total = 0.5 * self.total + self.digits + step
        metrics = {"total": self.total.clone()}
        return metrics if step % 2 else metrics | {"even": self.digits * step}

    def state_dict(self) -> dict[str, Tensor]:
        return {"total": self.total}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.total = state["total"].clone()


def train(
    learner: Counter,
    checkpoint: Path | None = None,
    names: Sequence[str] = NAMES,
    after: Callable[[int, Curves], bool] = lambda done, curves: False,
    **options: object,
) -> Curves:
    settings = {"steps": 20, "log_every": 4, "save_every": 0.0} | options
    return TrainingLoop(members=names, checkpoint=checkpoint, **settings).run(learner, after)


def lanes(curves: Curves, count: int = 3) -> list:
    return [curves.of_lane(lane) for lane in range(count)]


def test_curves_hold_means_over_intervals() -> None:
    curves = train(Counter(("a",)), names=("a",), steps=8)
    steps, values = curves.of_lane(0)["even"]
    assert steps == [4, 8]
    assert values == [1.0, 5.0]  # means of (0, 2) and (4, 6): only the updates that reported
    assert curves.of_lane(0)["total"][0] == [4, 8]


@pytest.mark.parametrize("deaths", [[0], [1], [3], [4], [5], [19], [2, 9, 11], [4, 8, 8, 16]])
def test_interrupted_equals_uninterrupted(tmp_path: Path, deaths: list[int]) -> None:
    whole = Counter()
    expected = lanes(train(whole))
    checkpoint = tmp_path / "c.safetensors"
    for death in deaths:
        with pytest.raises(RuntimeError):
            train(Counter(dies_at=death), checkpoint)
    last = Counter()
    curves = train(last, checkpoint)
    assert torch.equal(last.total, whole.total)
    assert lanes(curves) == expected
    assert last.updates == 20 - deaths[-1] // 4 * 4, "continued from the last interval"


def test_a_finished_checkpoint_trains_nothing(tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.safetensors"
    first, again = Counter(), Counter()
    expected = lanes(train(first, checkpoint))
    assert lanes(train(again, checkpoint)) == expected
    assert again.updates == 0
    assert torch.equal(again.total, first.total)


def test_part_of_the_lanes_can_be_finished_alone(tmp_path: Path) -> None:
    whole = Counter()
    expected = lanes(train(whole))
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(RuntimeError):
        train(Counter(dies_at=10), checkpoint)
    part = Counter(("c", "a"))
    curves = train(part, checkpoint, ("c", "a"))
    assert part.updates == 12
    assert part.total.tolist() == [float(whole.total[2]), float(whole.total[0])]
    assert lanes(curves, 2) == [expected[2], expected[0]]


def test_a_checkpoint_of_other_lanes_is_refused(tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.safetensors"
    train(Counter(("a", "b")), checkpoint, ("a", "b"))
    with pytest.raises(ValueError, match=r"c\.safetensors is a checkpoint of .* lacks \['c'\]"):
        train(Counter(("a", "c")), checkpoint, ("a", "c"))


@pytest.mark.parametrize(
    ("tensors", "header", "said"),
    [
        ({}, {"format": 0}, r"written by another version .*format 0"),
        ({}, {"package": "0.0.1"}, r"written by another version .*version 0\.0\.1"),
        ({}, {"format": ...}, r"written by another version .*format None"),
        ({"learner.total": ...}, {}, r"no checkpoint of this training .*total"),
        ({"learner.other": torch.zeros(3)}, {}, r"unexpected .*: other\)"),
        ({"learner.total": torch.zeros(3, 2)}, {}, r"of another shape: total\)"),
        ({"learner.total": torch.zeros(3).double()}, {}, r"of another shape: total\)"),
        ({"learner.total": torch.zeros(2)}, {}, "no checkpoint of this training"),
        ({"curve.total": ...}, {}, "lacks 'curve.total'|no checkpoint of this training"),
        ({}, {"members": 3}, "no checkpoint of this training"),
        ({}, {"done": None}, "no checkpoint of this training"),
        ({}, {"curve_steps": ...}, "no checkpoint of this training"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_named(
    tmp_path: Path, tensors: dict, header: dict, said: str
) -> None:
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(RuntimeError, match="killed"):
        train(Counter(dies_at=10), checkpoint)
    stored, told = load_tensors(checkpoint)
    stored, told = dict(stored) | tensors, told | header
    save_tensors(
        checkpoint,
        {name: value for name, value in stored.items() if value is not ...},
        {name: value for name, value in told.items() if value is not ...},
    )
    with pytest.raises(DamagedFileError, match=rf"c\.safetensors .*{said}") as caught:
        train(Counter(), checkpoint)
    assert caught.value.path == checkpoint
    assert "delete it to train from the beginning" in str(caught.value)


def test_stopping_early_is_remembered(tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.safetensors"
    calls: list[int] = []

    def stop_at_ten(done: int, curves: Curves) -> bool:
        calls.append(done)
        curves.add(done, {"seen": torch.full((3,), float(done))})
        return done == 10

    first = Counter()
    expected = lanes(train(first, checkpoint, after=stop_at_ten))
    assert calls == list(range(1, 11))
    again = Counter()
    assert lanes(train(again, checkpoint, after=stop_at_ten)) == expected
    assert again.updates == 0
    assert expected[0]["seen"][0] == list(range(1, 11))


@pytest.mark.parametrize("death", [6, 13])
def test_points_added_after_an_update_do_not_double(tmp_path: Path, death: int) -> None:
    def note(done: int, curves: Curves) -> bool:
        if done % 3 == 0:
            curves.add(done, {"note": torch.full((3,), float(done))})
        return False

    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(RuntimeError):
        train(Counter(dies_at=death), checkpoint, after=note)
    curves = train(Counter(), checkpoint, after=note)
    assert curves.of_lane(1)["note"] == ([3, 6, 9, 12, 15, 18], [3.0, 6.0, 9.0, 12.0, 15.0, 18.0])


def test_saves_only_when_due(tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(RuntimeError):
        train(Counter(dies_at=18), checkpoint, save_every=1e9)
    assert not checkpoint.exists()
    train(Counter(), checkpoint, save_every=1e9)
    assert checkpoint.is_file(), "the end is always saved"


def test_progress_rises_to_one() -> None:
    told: list[float] = []
    train(Counter(), progress=told.append)
    assert told == sorted(told)
    assert told[0] == 0.2
    assert told[-1] == 1.0


class Runner(Counter):
    """Does several updates at once, and notes which."""

    def __init__(self) -> None:
        super().__init__()
        self.runs: list[tuple[int, int]] = []

    def run_updates(self, first: int, count: int, sums: MetricSums) -> None:
        self.runs.append((first, first + count))
        for step in range(first, first + count):
            sums.add(self.update(step))


def test_a_run_of_updates_ends_at_the_next_event() -> None:
    def note(done: int, curves: Curves) -> bool:
        curves.add(done, {"note": torch.full((3,), float(done))})
        return False

    one_by_one, together, events = Counter(), Runner(), {6, 8, 11, 30}
    expected = lanes(train(one_by_one, after=lambda d, c: d in events and note(d, c)))
    curves = TrainingLoop(20, NAMES, log_every=8).run(together, note, events)
    assert together.runs == [(0, 6), (6, 8), (8, 11), (11, 16), (16, 20)]
    assert curves.of_lane(0)["note"][0] == [6, 8, 11]
    assert torch.equal(together.total, one_by_one.total)
    again = TrainingLoop(20, NAMES, log_every=4).run(Runner(), note, events)
    assert lanes(again) == expected


def test_without_numbers_a_call_follows_every_update() -> None:
    made = Runner()
    train(made, steps=3)
    assert made.runs == [(0, 1), (1, 2), (2, 3)]


def test_stopping_is_asked_for_at_events_alone() -> None:
    made = Runner()
    TrainingLoop(20, NAMES, log_every=5).run(made, lambda done, curves: True, range(7, 20, 7))
    assert made.updates == 7


def test_sums_stay_where_they_are() -> None:
    sums = MetricSums()
    sums.add({"a": torch.tensor([1.0]), "b": torch.tensor([5.0])})
    place = sums._totals["a"]
    sums.add({"a": torch.tensor([2.0])})
    assert {name: mean.item() for name, mean in sums.means().items()} == {"a": 1.5, "b": 5.0}
    sums.clear()
    assert sums.means() == {}
    sums.add({"a": torch.tensor([4.0])})
    assert sums._totals["a"] is place
    assert sums.means() == {"a": torch.tensor([4.0])}
