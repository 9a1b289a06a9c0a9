"""The protocol: its grid, its ranges and the names it is stored under."""

import pytest

from components.evaluation.protocol import EvaluationProtocol


def test_grid_of_the_proximity() -> None:
    grid = EvaluationProtocol().proximities
    assert len(grid) == 21
    assert grid[:3] == (0.0, 0.05, 0.1)
    assert grid[-1] == 1.0
    assert EvaluationProtocol(proximity_step=1.0).proximities == (0.0, 1.0)
    assert len(EvaluationProtocol(proximity_step=1 / 3).proximities) == 4


@pytest.mark.parametrize(
    "fields",
    [
        {"trajectories": 0},
        {"horizon": 0},
        {"proximity_step": 0.0},
        {"proximity_step": 0.005},
        {"proximity_step": 0.3},
        {"proximity_step": 1.5},
        {"proximity_step": float("nan")},
        {"discount": 0.0},
        {"discount": 1.01},
    ],
)
def test_protocols_out_of_range_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(fields))):
        EvaluationProtocol(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("step", [0.01, 0.02, 0.04, 0.05, 0.1, 0.125, 0.2, 0.25, 0.5, 1.0, 1 / 93])
def test_every_step_that_divides_one_is_accepted(step: float) -> None:
    grid = EvaluationProtocol(proximity_step=step).proximities
    assert len(grid) == round(1 / step) + 1


def test_records_have_the_names_of_stored_results_and_are_read_back() -> None:
    protocol = EvaluationProtocol(trajectories=3, horizon=7, proximity_step=0.5)
    record = protocol.record(0.9)
    assert record == {"trajectories": 3, "horizon": 7, "lambda_step": 0.5, "discount": 0.9}
    assert EvaluationProtocol.of_record(record) == (protocol, 0.9)


def test_a_chosen_discount_takes_the_place_of_the_logs() -> None:
    assert EvaluationProtocol(discount=0.99).record(0.97)["discount"] == 0.99
    assert EvaluationProtocol(discount=1.0).record(0.97)["discount"] == 1.0
