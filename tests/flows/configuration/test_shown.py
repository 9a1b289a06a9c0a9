"""Shown settings: they are complete, and the command line takes them."""

import sys
from dataclasses import asdict
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

import pytest
import yaml

import flows
from flows.__main__ import doors
from flows.__main__ import main as list_doors
from flows.command_line import main
from flows.configuration.settings import ALIASES, load_settings
from flows.configuration.shown import settings_yaml


def shown(*words: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(settings_yaml(load_settings(words)))
    return found


def leaves(fields: dict[str, Any], path: str = "") -> list[str]:
    """The words that give every setting of a group."""
    words = []
    for name, value in fields.items():
        if isinstance(value, dict):
            words += leaves(value, f"{path}{name}.")
        else:
            word = str(value).replace("'", "").replace("None", "null")
            words.append(f"{path}{name}={word}")
    return words


def test_every_setting_is_shown_with_its_value() -> None:
    settings = load_settings(["profile=quick", "algorithm.lion.hidden=[7]"])
    found = shown("profile=quick", "algorithm.lion.hidden=[7]")
    for group in ("algorithm", "model"):
        for name, config in getattr(settings, group).items():
            plain = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(config).items()}
            assert found[group][name] == plain
    assert found["algorithm"]["lion"]["hidden"] == [7]
    assert found["evaluation"] == {
        "trajectories": 10,
        "horizon": 100,
        "proximity_step": 0.05,
        "discount": None,
    }
    assert found["experts"]["training"]["random_steps"] == 25_000
    assert found["algorithms"] == ["bc", "ddpg", "td3_bc", "lion"]
    assert list(found["dataset"]) == list(settings.datasets)


def test_what_is_shown_given_as_words_makes_the_same_settings() -> None:
    found = shown("profile=smoke")
    del found["dataset"]
    again = load_settings(leaves(found))
    smoke = load_settings(["profile=smoke"])
    for name in type(smoke).model_fields.keys() - {"model_overrides", "special"}:
        assert getattr(again, name) == getattr(smoke, name), name


def test_settings_that_a_dataset_changes_are_shown_below_it() -> None:
    found = shown("datasets=[bad-0.4,hopper]")["dataset"]
    assert found["bad-0.4"] == {
        "controller": "bad", "epsilon": 0.4, "setpoint": 70.0, "trajectories": 100, "steps": 1000,
        "discount": 0.97,
    }  # fmt: skip
    hopper = found["hopper"]
    assert hopper["algorithm"]["morel"] == {"discount": 0.99, "halt_offset": 50.0}
    assert "moose" in hopper["algorithm"]
    assert "updates" not in hopper["algorithm"]["moose"], "hopper's own are the general ones"
    assert hopper["model"]["behaviour_policy"] == {"hidden": [128, 128], "epochs": 10}
    assert hopper["model_for"] == {"wsbc": {"behaviour_policy": {"hidden": [40]}}}


def doors_of_main() -> list[ModuleType]:
    """The modules directly in flows that end with `command_line.main`."""
    modules = [import_module(f"flows.{found.name}") for found in iter_modules(flows.__path__)]
    return [m for m in modules if hasattr(m, "HELP") and getattr(m, "main", None) is main]


def test_there_are_doors() -> None:
    names = {door.__name__.removeprefix("flows.") for door in doors_of_main()}
    assert names >= {"full_benchmark", "generate_data", "tune_models", "train_experts"}


@pytest.mark.parametrize("door", doors_of_main(), ids=lambda door: door.__name__)
def test_every_door_shows_its_settings_and_stops(
    door: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["door", "profile=smoke", "show_settings=true"])
    with pytest.raises(SystemExit) as ended:
        main("door", door.HELP, pytest.fail, getattr(door, "ALIASES", ALIASES))
    assert ended.value.code == 0
    assert yaml.safe_load(capsys.readouterr().out)["profile_name"] == "smoke"
    assert "  show_settings=true " in door.HELP


def test_the_package_names_its_doors(capsys: pytest.CaptureFixture[str]) -> None:
    list_doors()
    lines = capsys.readouterr().out.splitlines()
    named = [line.split()[0] for line in lines[2:]]
    assert named == list(doors())
    own = {door.__name__.removeprefix("flows.") for door in doors_of_main()}
    assert {*own, "render", "ui"} <= set(named)
    assert not {"__main__", "command_line"} & set(named)
    assert all(len(line.split()) > 2 for line in lines[2:])
