"""Checked objects: every number of every setting has bounds, whoever defines it."""

import dataclasses
from typing import Any

import pytest

from components.evaluation.protocol import EvaluationProtocol
from components.experts.config import ExpertConfig
from flows.configuration.checking import SettingsError, build_config, hint
from flows.configuration.defaults import ALGORITHM_CONFIGS, MODEL_CONFIGS

KINDS: dict[str, Any] = {
    **{f"algorithm.{name}": kind for name, kind in ALGORITHM_CONFIGS.items()},
    **{f"model.{name}": kind for name, kind in MODEL_CONFIGS.items()},
    "evaluation": EvaluationProtocol,
    "experts.training": ExpertConfig,
}
MAY_BE_NEGATIVE = {("algorithm.morel", name) for name in ("beta", "halt_reward", "initial_log_std")}


@pytest.mark.parametrize("path", KINDS)
def test_no_number_is_undefined_infinite_huge_or_negative_by_mistake(path: str) -> None:
    defaults = dataclasses.asdict(KINDS[path]())
    build_config(KINDS[path], path, defaults)
    for name, default in defaults.items():
        if isinstance(default, bool | str):
            continue
        wrong: list[Any] = [float("nan"), float("inf"), 1e39, 2**63]
        wrong += [] if (path, name) in MAY_BE_NEGATIVE else [-1]
        for value in wrong:
            given = [value] if isinstance(default, tuple) else value
            with pytest.raises(SettingsError, match=rf"^{path}") as caught:
                build_config(KINDS[path], path, defaults | {name: given})
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("LION", " Did you mean 'lion'?"),
        ("bad-0.5", " Of this kind there are bad-0.4, bad-0.6."),
        ("BAD-0.4", " Did you mean 'bad-0.4'?"),
        ("bed-0.4", " Did you mean 'bad-0.4'?"),
        ("quite different", ""),
    ],
)
def test_the_word_that_was_meant_is_named(word: str, says: str) -> None:
    assert hint(word, ["lion", "bad-0.4", "bad-0.6"]) == says
