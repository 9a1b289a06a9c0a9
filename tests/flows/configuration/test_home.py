"""A folder of one's own beside the project: its datasets are found, and nothing else changes."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.configuration import composition
from flows.configuration.checking import SettingsError
from flows.configuration.files import CONF, HOME, home, names_in, read_datasets
from flows.configuration.settings import load_settings
from tests.components.synthetic import make_log


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An own folder with a log."""
    (tmp_path / "conf" / "dataset").mkdir(parents=True)
    make_log().write(tmp_path / "logs" / "mine")
    named(tmp_path, "mine", "log: logs/mine")
    monkeypatch.setenv(HOME, str(tmp_path))
    composition.base_layers.cache_clear()
    yield tmp_path
    composition.base_layers.cache_clear()


def named(folder: Path, name: str, fields: str) -> None:
    path = folder / "conf" / "dataset" / f"{name}.yaml"
    path.write_text(f"{name}:\n  {fields}\n", encoding="utf-8")


def test_its_datasets_are_there_beside_those_of_the_project(own: Path) -> None:
    settings = load_settings(("datasets=[mine,bad-0.4]", "profile=smoke"))
    assert settings.dataset["mine"].folder == own / "logs" / "mine"
    assert settings.dataset["bad-0.4"].name == "bad-0.4"
    assert {*read_datasets(CONF / "dataset").content} == {*names_in(CONF / "dataset"), "mine"}


def test_without_own_datasets_and_without_the_variable_there_are_those_of_the_project(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (own / "conf" / "dataset" / "mine.yaml").unlink()
    assert {*read_datasets(CONF / "dataset").content} == {*names_in(CONF / "dataset")}
    monkeypatch.delenv(HOME)
    assert home() == CONF.parent
    assert {*read_datasets(CONF / "dataset").content} == {*names_in(CONF / "dataset")}


def test_a_name_of_the_project_and_a_missing_folder_are_refused(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named(own, "bad-0.4", "log: logs/mine")
    with pytest.raises(SettingsError, match=r"bad-0\.4\.yaml has a name of this project; rename"):
        load_settings(("datasets=[bad-0.2]",))
    monkeypatch.setenv(HOME, str(own / "gone"))
    with pytest.raises(SettingsError, match=r"PROXIMITY_BENCH_HOME=.*gone is no folder; make it"):
        read_datasets(CONF / "dataset")


def test_a_broken_file_there_matters_to_those_who_select_it(own: Path) -> None:
    named(own, "mine", "- list")
    load_settings(("datasets=[bad-0.2]", "profile=smoke"))
    with pytest.raises(SettingsError, match="mine"):
        load_settings(("datasets=[mine]", "profile=smoke"))
