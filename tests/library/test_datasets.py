"""Logs as the library opens them: names, DataFrames, folders, files, Minari; what is refused."""

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import proximity_bench as pb
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.minari_exchange import export_minari
from proximity_bench.datasets import DoubtfulLogWarning
from tests.components.synthetic import make_log
from tests.flows.furnace import SCHEMA, as_csv, furnace, write_schema

SMALL = {"trajectories": 3, "steps": 40}


@pytest.fixture(scope="module")
def csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "furnace.csv"
    path.write_text(as_csv(furnace()), encoding="utf-8")
    return path


def test_a_name_is_the_dataset_of_a_sweep() -> None:
    log = pb.dataset("mediocre-0.2", seed=3, **SMALL)
    same = IndustrialSpec("mediocre-0.2", "mediocre", 0.2, **SMALL).generate(3)
    assert log.card == same.card


def test_a_cache_keeps_what_was_generated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = pb.dataset("bad-0.4", cache=tmp_path, **SMALL)
    monkeypatch.setattr("proximity_bench.datasets.generate", None)
    assert pb.dataset("bad-0.4", cache=tmp_path, **SMALL).card == made.card
    for other in ({**SMALL, "seed": 1}, {**SMALL, "steps": 41}):
        with pytest.raises(TypeError):  # generates
            pb.dataset("bad-0.4", cache=tmp_path, **other)


def test_a_frame_of_pandas_is_the_log_in_its_file(csv: Path) -> None:
    rows = pd.read_csv(csv, parse_dates=["time"])
    log = pb.dataset(rows, schema=SCHEMA, name="furnace")
    assert log.card.name == "furnace"
    assert log.card.action_bounds == ((0.0, 100.0), (0.0, 50.0))
    from_file = pb.dataset(csv, schema=write_schema(csv.parent))
    assert log.card.digest == from_file.card.digest
    assert from_file.card.name == "log"
    by_index = pb.dataset(rows.set_index(["run", "time"]), schema=SCHEMA)
    assert by_index.card.digest == log.card.digest


def test_long_frames_are_read_in_parts(csv: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = pd.read_csv(csv, parse_dates=["time"])
    whole = pb.dataset(rows, schema=SCHEMA)
    monkeypatch.setattr("components.data.imports.frame_of_rows._ROWS", 50)
    assert pb.dataset(rows, schema=SCHEMA).card.digest == whole.card.digest


def test_folders_open_under_their_own_or_another_name(tmp_path: Path) -> None:
    log = make_log("plant")
    log.write(tmp_path / "logs" / "plant")
    assert pb.dataset(tmp_path / "logs" / "plant").card == log.card
    assert pb.dataset(str(tmp_path / "logs" / "plant"), name="other").card.name == "other"


def test_minari_gives_back_what_this_project_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(os.environ, "MINARI_DATASETS_PATH", str(tmp_path))
    log = pb.dataset("bad-0.4", **SMALL)
    assert pb.dataset(f"minari:{export_minari(log, tmp_path)}").card == log.card


def spoiled(**columns: Any) -> pd.DataFrame:
    rows = pd.DataFrame(
        {name: pd.to_numeric(cells) for name, cells in furnace().items() if name != "time"}
    )
    return rows.astype(object).assign(**columns) if columns else rows


PLAIN = {name: value for name, value in SCHEMA.items() if name not in ("time", "sampling")}


def missing() -> pd.DataFrame:
    rows = spoiled()
    rows.loc[17, "oxygen"] = np.nan
    return rows


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("mediocre-0.3",), "Unknown dataset 'mediocre-0.3'; valid ones are .*Of this kind there"),
        (("swimer",), "Did you mean 'swimmer'?"),
        (("logs/nowhere",), "There is no logs/nowhere; give a folder, a file or a name"),
        (("minari:no/such-v0",), "minari:no/such-v0: there is no such dataset below"),
        ((spoiled(),), "A DataFrame needs schema=, what its columns mean"),
        ((spoiled(), {**PLAIN, "featurs": []}), "Unknown key 'schema.featurs'.*mean 'features'"),
        ((spoiled(), "nowhere.yaml"), "There is no schema nowhere.yaml; see docs/own_log.md"),
        ((spoiled()[[]], PLAIN), "the DataFrame has no column 'temperature'"),
        ((spoiled()[:0], PLAIN), "the DataFrame has no rows"),
        ((spoiled(oxygen="low"), PLAIN), "column 'oxygen' holds .*string from row 1 on"),
        ((missing(), PLAIN), "the DataFrame, row 18: .*'oxygen'"),
        (
            (pd.concat([spoiled(), spoiled()[["gas"]]], axis=1), PLAIN),
            "the DataFrame has 2 columns of the name 'gas'",
        ),
        ((spoiled(oxygen=[1.0, "low"] * 90), PLAIN), "column 'oxygen' holds values of several"),
        ((spoiled(oxygen=None), PLAIN), "'oxygen'"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    arguments: tuple, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(os.environ, "MINARI_DATASETS_PATH", str(tmp_path))
    source, *schema = arguments
    with pytest.raises(ValueError, match=reason) as error:
        pb.dataset(source, schema=schema[0] if schema else None)
    assert "\n" not in str(error.value)


def test_texts_for_no_value_in_a_dataframe_are_missing() -> None:
    rows = spoiled()
    rows = rows.astype({"oxygen": object})
    rows.loc[17, "oxygen"] = "Bad Input"
    log = pb.dataset(rows, schema={**PLAIN, "na_values": ["Bad Input"]}, missing="forward_fill")
    assert log.frames[17, 1] == log.frames[16, 1]


@pytest.mark.parametrize(
    ("source", "options", "reason"),
    [
        ("bad-0.4", {"schema": SCHEMA}, "has no use: bad-0.4 is generated; leave it out"),
        ("bad-0.4", {"episodes": 4}, "Unknown key 'data.episodes'; valid keys there: seed, traj"),
        (spoiled(), {"schema": PLAIN, "cache": "x"}, "cache='x' has no use: nothing is generated"),
        (spoiled(), {"schema": PLAIN, "steps": 40}, "has no use: a stored log has its own"),
        (spoiled(), {"schema": PLAIN, "name": "hopper"}, "name='hopper' is a generated dataset"),
    ],
)
def test_arguments_without_use_are_refused(source: Any, options: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        pb.dataset(source, **options)


def test_repairs_are_those_of_the_import() -> None:
    assert pb.dataset(missing(), schema=PLAIN, missing="drop_episode").episodes == 5


def test_what_looks_wrong_in_a_table_is_warned_of_once(tmp_path: Path) -> None:
    rows = spoiled()
    rows["air"] = np.arange(len(rows)) % 3 * 20.0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pb.dataset(rows, schema=PLAIN).write(tmp_path / "log")
    [said] = [one for one in caught if "Action 'air' takes 3 values only" in str(one.message)]
    assert said.category is DoubtfulLogWarning
    assert said.filename == __file__  # where the user has asked for the log
    with warnings.catch_warnings():
        warnings.simplefilter("error", DoubtfulLogWarning)
        pb.dataset(tmp_path / "log")  # an import has said it before
