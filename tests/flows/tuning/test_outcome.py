"""Exit codes of searches."""

import pytest

from flows.tuning.outcome import SearchOutcome


@pytest.mark.parametrize(
    ("outcome", "code", "status"),
    [
        (SearchOutcome(), 0, "FINISHED"),
        (SearchOutcome(failed=["a study"]), 1, "FAILED"),
        (SearchOutcome(unrecorded="MLflow is away."), 1, "FINISHED"),
        (SearchOutcome(interrupted=143, unrecorded="MLflow is away."), 143, "KILLED"),
    ],
)
def test_only_a_search_that_is_found_and_recorded_ends_well(
    outcome: SearchOutcome, code: int, status: str
) -> None:
    assert (outcome.exit_code, outcome.status) == (code, status)
