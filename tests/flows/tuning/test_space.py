"""Every model can be searched, and whatever is drawn is a valid configuration."""

import dataclasses
import functools

import optuna
import pytest

from components.models import MODELS
from flows.configuration.settings import load_settings
from flows.tuning import space as spaces
from flows.tuning.space import SPACES, Choice, IntegerRange, Range, RangeOrZero

settings_of = functools.cache(lambda profile: load_settings([f"profile={profile}"]))
NEVER = {"members", "elites", "holdout", "horizon", "epochs", "updates", "validate_every",
         "patience", "improvement", "action_clip", "networks", "memoryless"}  # fmt: skip


def test_every_model_has_a_space() -> None:
    assert set(SPACES) == set(MODELS)


@pytest.mark.parametrize("model", SPACES)
def test_spaces_vary_nothing_that_changes_the_meaning_of_the_loss(model: str) -> None:
    fields = {field.name for field in dataclasses.fields(MODELS[model].config)}
    assert set(SPACES[model]) <= fields - NEVER
    # whatever else there is to choose is searched
    assert fields - NEVER == set(SPACES[model])


@pytest.mark.parametrize("model", SPACES)
def test_defaults_lie_inside(model: str) -> None:
    start = MODELS[model].config()
    for name, kind in SPACES[model].items():
        value = getattr(start, name)
        if isinstance(kind, Choice):
            assert value in kind.options, name
        elif isinstance(kind, RangeOrZero):
            assert value == 0 or kind.low <= value <= kind.high, name
        else:
            assert kind.low <= value <= kind.high, name
    drawn = spaces.parameters(SPACES[model], start)
    assert spaces.settings(SPACES[model], start, drawn) == start


@pytest.mark.parametrize("profile", ["paper", "quick", "smoke"])
@pytest.mark.parametrize("model", SPACES)
def test_whatever_is_drawn_is_valid(model: str, profile: str) -> None:
    start = settings_of(profile).model[model]
    space = spaces.distributions(SPACES[model], start)
    sampler = optuna.samplers.RandomSampler(seed=0)
    study = optuna.create_study(sampler=sampler)
    study.enqueue_trial(spaces.parameters(SPACES[model], start))
    made = [spaces.settings(SPACES[model], start, study.ask(space).params) for _ in range(60)]
    assert made[0] == start
    assert len(set(made)) > 50
    for config in made:
        assert type(config) is MODELS[model].config
        # the loss means the same for all
        assert spaces.fixed(SPACES[model], config) == spaces.fixed(SPACES[model], start)


def test_a_start_outside_widens_the_space_and_is_kept_exactly() -> None:
    @dataclasses.dataclass(frozen=True)
    class Config:
        rate: float = 0.123456789
        decay: float = 3e-9
        width: int = 7
        layers: tuple[int, ...] = (5, 3)

    space = {
        "rate": Range(1e-4, 1e-2),
        "decay": RangeOrZero(1e-6, 1e-2),
        "width": IntegerRange(10, 20),
        "layers": Choice(((1,), (2, 2))),
    }
    start = Config()
    drawn = spaces.parameters(space, start)
    assert drawn["layers"] == "5-3"
    for name, distribution in spaces.distributions(space, start).items():
        assert distribution._contains(distribution.to_internal_repr(drawn[name])), name
    assert spaces.settings(space, start, drawn) == start
    other = drawn | {"decay": 5e-7, "layers": "2-2", "rate": 0.00123456}
    assert spaces.settings(space, start, other) == Config(
        rate=0.00123, decay=0.0, width=7, layers=(2, 2)
    )
