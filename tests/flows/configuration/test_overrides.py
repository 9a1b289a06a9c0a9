"""Words of a command line are read by the type of the setting: text is text."""

from pathlib import Path

import pytest

from flows.configuration.field_types import is_text, is_text_list, type_at
from flows.configuration.schema import Settings
from flows.configuration.settings import load_settings


@pytest.mark.parametrize(
    "folder",
    [
        *("/data/epoch=3", "/data/run#1", "/data/läufe", "/data/a(b)", "/data/a&b", "/data/a,b"),
        *("2026", "1e3", "true", "null", "[a]", "a b", "run:1", "100%", "a'b", "*", "{a}"),
    ],
)
def test_a_folder_is_the_text_that_was_typed(folder: str) -> None:
    assert load_settings([f"store={folder}"]).store == Path(folder)
    assert load_settings([f"store='{folder}'"]).store == Path(folder), "quotes keep working"
    assert load_settings([f'store="{folder}"']).store == Path(folder)


@pytest.mark.parametrize("name", ["20261127", "2026_11_27", "1e3", "true", "0x1", "1.10"])
def test_a_sweep_is_called_as_was_typed(name: str) -> None:
    assert load_settings([f"sweep={name}"]).sweep == name
    assert load_settings([f"sweep='{name}'"]).sweep == name


def test_null_is_nothing_where_text_may_be_missing() -> None:
    assert load_settings(["sweep=null"]).sweep is None
    assert load_settings(["runner.cpus=null"]).runner.cpus is None


def test_folders_begin_at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    settings = load_settings(["store=~/runs", "models.folder=~/tuned"])
    assert settings.store == Path("/home/somebody/runs")
    assert settings.models.folder == Path("/home/somebody/tuned")
    assert load_settings(["store=a~b/~"]).store == Path("a~b/~")


@pytest.mark.parametrize(
    "words", ["[bad-0.4,hopper]", "[ bad-0.4 , 'hopper' ]", '["bad-0.4",hopper]']
)
def test_names_in_a_list_are_text(words: str) -> None:
    assert load_settings([f"datasets={words}"]).datasets == ("bad-0.4", "hopper")
    assert load_settings(["datasets=hopper"]).datasets == ("hopper",)


def test_the_schema_tells_the_types() -> None:
    texts = ("store", "sweep", "models.folder", "models.source", "runner.executor")
    assert all(is_text(type_at(Settings, key)) for key in texts)
    assert is_text(type_at(Settings, "algorithm.moose.optimizer"))
    assert is_text(type_at(Settings, "domain.mujoco.algorithm.moose.optimizer"))
    assert is_text(type_at(Settings, "domain.mujoco.model_for.lion.action_vae.schedule"))
    lists = ("datasets", "algorithms", "tuning.models", "experts.robots")
    assert all(is_text_list(type_at(Settings, key)) for key in lists)
    others = ("seeds", "algorithm.lion.hidden", "algorithm.lion", "data.seed", "no.such.key")
    assert not any(is_text(type_at(Settings, key)) for key in (*others, *lists))
    assert not any(is_text_list(type_at(Settings, key)) for key in (*others, *texts))
