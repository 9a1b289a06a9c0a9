"""Random streams: a lane's numbers are a function of its key, the purpose and the step alone."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from components.core.draws import (
    Beta,
    Choice,
    Draw,
    Integers,
    Normal,
    Order,
    Uniform,
    UniformDouble,
)
from components.core.random_streams import (
    LaneStreams,
    lane_generator,
    lane_key,
    spawn_generators,
)

CPU = torch.device("cpu")
KEYS = [lane_key("toy", "lion", seed) for seed in range(3)]
NAMES = ("noise", "row")
# Of the first key at step 5, as this code drew them when its versions were last raised.
ROW = [424, 163, 342]
NOISE = [0.784861, 0.294748, 0.734826, 0.777192]
EVERY: dict[str, Draw] = {
    "normal": Normal(5, 3),
    "uniform": Uniform(7, low=-1.0),
    "double": UniformDouble(3),
    "integers": Integers([10, 1000, 100_000], 9),
    "choice": Choice([np.array([4]), np.arange(3), np.array([7, 9])], 5),
    "order": Order(11),
    "beta": Beta(0.6, 6),
    "none": Integers([5] * 3, 0),
}


def streams(keys: Sequence[int] = KEYS, draws: dict[str, Draw] | None = None) -> LaneStreams:
    rows = Integers([1000] * len(keys), 3)
    return LaneStreams(keys, draws or {"noise": Normal(4), "row": rows}, CPU, block=7)


def test_equal_keys_give_equal_numbers_and_others_do_not() -> None:
    first, again = streams().at(5), streams().at(5)
    assert first["noise"].shape == (3, 4)
    assert first["row"].dtype == torch.int64
    for name in NAMES:
        assert torch.equal(first[name], again[name])
    assert not torch.equal(first["noise"][0], first["noise"][1])
    other = streams([lane_key("toy", "lion", 9)]).at(5)
    assert not torch.equal(first["noise"][0], other["noise"][0])


def test_a_lane_in_a_stack_draws_what_it_draws_alone() -> None:
    together = streams()
    for lane, key in enumerate(KEYS):
        alone = streams([key])
        for step in (0, 6, 7, 20):
            for name in NAMES:
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


def test_generators_of_one_key_are_far_apart_in_the_stream() -> None:
    # A block that ran into the next one would repeat its numbers at an offset.
    first = lane_generator(KEYS[0], 0).random(100_000)
    second = lane_generator(KEYS[0], 1).random(1000)
    assert not np.isin(second, first).any()


def test_purposes_do_not_disturb_one_another() -> None:
    both, alone = streams(), streams(draws={"noise": Normal(4)})
    assert torch.equal(both.at(9)["noise"], alone.at(9)["noise"])
    twins = streams(draws={"a": Normal(4), "b": Normal(4)}).at(0)
    assert not torch.equal(twins["a"], twins["b"])
    [weights], [other] = spawn_generators(KEYS[:1], "weights"), spawn_generators(KEYS[:1], "other")
    assert weights.random() != other.random()


def test_numbers_do_not_depend_on_how_many_steps_are_drawn_at_once() -> None:
    for step in (0, 8, 23):
        alone, several = (LaneStreams(KEYS, EVERY, CPU, block).at(step) for block in (1, 10))
        for name in EVERY:
            assert torch.equal(alone[name], several[name]), name


def test_every_device_has_the_words_of_the_host() -> None:
    host, device = (LaneStreams(KEYS, EVERY, CPU) for _ in range(2))
    for first, count in ((0, 1), (13, 4), (10**12, 2)):
        host.stage(first, count)
        device.stage(first, count)
        ours, theirs = device._device_words(count), host._host_words(count)
        for name in EVERY:
            assert torch.equal(ours[name], theirs[name]), name


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no GPU")
def test_a_gpu_draws_what_the_host_draws() -> None:
    """Integers bit for bit; single precision's elementary functions differ in their last digits."""
    gpu = LaneStreams(KEYS, EVERY, torch.device("cuda"))
    host = LaneStreams(KEYS, EVERY, CPU)
    for step in (0, 9, 1234):
        for name, numbers in host.at(step).items():
            found = gpu.at(step)[name].cpu()
            if numbers.is_floating_point():
                torch.testing.assert_close(found, numbers, rtol=1e-5, atol=1e-5)
            else:
                assert torch.equal(found, numbers)


def test_staged_steps_are_those_of_any_other_time() -> None:
    staged, fresh = streams(), streams()
    for first, count in ((40, 3), (5, 1), (47, 3)):
        staged.stage(first, count)
        staged.draw(count)
        for step in range(first, first + count):
            for name in NAMES:
                assert torch.equal(staged.at(step)[name], fresh.at(step)[name])
    staged.stage(60, 3)  # drawn by a graph, whose numbers lie elsewhere
    assert torch.equal(staged.at(60)["noise"], fresh.at(60)["noise"])


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
    drawn = streams().at(5)
    assert drawn["row"][0].tolist() == ROW
    # Elementary functions of other processors differ in their last digits.
    torch.testing.assert_close(drawn["noise"][0], torch.tensor(NOISE), rtol=1e-5, atol=1e-6)
