"""Random streams: a lane's numbers are a function of its key, the purpose and the step alone."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from components.core.random_streams import (
    Draw,
    LaneStreams,
    lane_generator,
    lane_key,
    spawn_generators,
)

CPU = torch.device("cpu")
DRAWS: dict[str, Draw] = {
    "noise": lambda g, lane, steps: g.standard_normal((steps, 4), np.float32),
    "row": lambda g, lane, steps: g.integers(1000, size=(steps, 3)),
}
KEYS = [lane_key("toy", "lion", seed) for seed in range(3)]


def streams(keys: Sequence[int] = KEYS, draws: dict[str, Draw] = DRAWS) -> LaneStreams:
    return LaneStreams(keys, draws, CPU, block=7)


def test_equal_keys_give_equal_numbers_and_others_do_not() -> None:
    first, again = streams().at(5), streams().at(5)
    assert first["noise"].shape == (3, 4)
    assert first["row"].dtype == torch.int64
    for name in DRAWS:
        assert torch.equal(first[name], again[name])
    assert not torch.equal(first["noise"][0], first["noise"][1])
    other = streams([lane_key("toy", "lion", 9)]).at(5)
    assert not torch.equal(first["noise"][0], other["noise"][0])


def test_a_lane_in_a_stack_draws_what_it_draws_alone() -> None:
    together = streams()
    for lane, key in enumerate(KEYS):
        alone = streams([key])
        for step in (0, 6, 7, 20):
            for name in DRAWS:
                assert torch.equal(together.at(step)[name][lane], alone.at(step)[name][0])


def test_steps_may_be_asked_for_in_any_order() -> None:
    forwards = streams()
    expected = [forwards.at(step)["noise"] for step in range(20)]
    jumping = streams()
    for step in (19, 0, 13, 14, 6, 7, 7, 1):
        assert torch.equal(jumping.at(step)["noise"], expected[step])


def test_no_numbers_repeat_across_steps_and_block_boundaries() -> None:
    drawn = streams(KEYS[:1])
    seen = torch.stack([drawn.at(step)["noise"][0] for step in range(70)])  # ten blocks
    assert len(torch.unique(seen)) == seen.numel()


def test_blocks_are_far_apart_in_the_stream() -> None:
    # A block that ran into the next one would repeat its numbers at an offset.
    first = lane_generator(KEYS[0], 0).random(100_000)
    second = lane_generator(KEYS[0], 1).random(1000)
    assert not np.isin(second, first).any()


def test_purposes_do_not_disturb_one_another() -> None:
    both, alone = streams(), streams(draws={"noise": DRAWS["noise"]})
    assert torch.equal(both.at(9)["noise"], alone.at(9)["noise"])
    twins = streams(draws={"a": DRAWS["noise"], "b": DRAWS["noise"]}).at(0)
    assert not torch.equal(twins["a"], twins["b"])
    [weights], [other] = spawn_generators(KEYS[:1], "weights"), spawn_generators(KEYS[:1], "other")
    assert weights.random() != other.random()


def test_draws_know_their_lane() -> None:
    drawn = LaneStreams(KEYS, {"lane": lambda g, lane, steps: np.full((steps,), lane)}, CPU)
    assert drawn.at(3)["lane"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("other", [("ab", "c"), ("a", "bc", ""), ("a", "bd"), ("bc", "a")])
def test_names_do_not_run_into_each_other(other: tuple[str, ...]) -> None:
    assert lane_key("a", "bc") == lane_key("a", "bc")
    assert lane_key("a", "bc") != lane_key(*other)


def test_numbers_are_the_ones_results_were_made_with() -> None:
    # A change here changes every result and must come with new versions of all components.
    assert lane_key("mediocre-0.2", "lion", 3) == 340260282863687890496256865367631918760
    assert lane_generator(lane_key("a"), 2).integers(10**9, size=3).tolist() == [
        719976869,
        456796296,
        504299673,
    ]


def test_staged_draws_lie_where_those_of_the_last_stage_lay() -> None:
    staged, fresh = streams(), streams()
    staged.stage(2, 3)
    staged.draw(3)
    places = [staged.at(step)["noise"] for step in (2, 3, 4)]
    for step, place in zip((2, 3, 4), places, strict=True):
        assert torch.equal(place, fresh.at(step)["noise"])
    staged.stage(7, 1)
    staged.draw(1)
    staged.stage(9, 3)
    staged.draw(3)
    for step, place in zip((9, 10, 11), places, strict=True):
        assert staged.at(step)["noise"].data_ptr() == place.data_ptr()
        assert torch.equal(place, fresh.at(step)["noise"])
    assert torch.equal(staged.at(12)["noise"], fresh.at(12)["noise"])
