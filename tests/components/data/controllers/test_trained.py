"""Experts on disk: the way there and back, and what missing or damaged files say."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from components.data.controllers.trained.shipped import Expert
from tests.components.data.sources.toy_robot import toy_expert


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "toy").mkdir()
    toy_expert().save(tmp_path / "toy")
    return tmp_path / "toy"


def test_round_trip(folder: Path) -> None:
    expert, loaded = toy_expert(), Expert.load(folder)
    assert loaded.policy.card == expert.policy.card
    assert loaded.card.digest
    assert {**vars(loaded.card), "digest": ""} == vars(expert.card)
    frames = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_array_equal(loaded.act(frames), expert.act(frames))


def test_acting_in_double_precision_is_the_policys_action() -> None:
    expert = toy_expert(scale=3.0)
    frames = np.random.default_rng(0).normal(size=(50, 3))
    policys = expert.policy.act(torch.from_numpy(frames).float()[None, :, None])[0]
    np.testing.assert_allclose(expert.act(frames), policys, atol=1e-5)  # float32
    one_by_one = np.concatenate([expert.act(frame[None]) for frame in frames])
    # double precision: no float32 action can tell the size of the batch
    np.testing.assert_allclose(one_by_one, expert.act(frames), atol=1e-14)


@pytest.mark.parametrize("name", ["expert.json", "policy.json", "weights.safetensors"])
def test_a_missing_file_is_named_with_its_remedy(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=r"python -m flows\.train_experts") as error:
        Expert.load(folder)
    assert str(folder) in str(error.value)
    assert "\n" not in str(error.value)


def test_damage_is_named_with_its_remedy(folder: Path) -> None:
    path = folder / "weights.safetensors"
    whole = path.read_bytes()
    for damaged in (whole[:-1] + bytes([whole[-1] ^ 1]), whole[:100]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"damaged.*python -m flows\.train_experts"):
            Expert.load(folder)
    path.write_bytes(whole)
    card = folder / "expert.json"
    values = json.loads(card.read_text())
    for text in ("{", "[]", json.dumps({**values, "colour": "red"})):
        card.write_text(text)
        with pytest.raises(ValueError, match=r"expert\.json cannot be used .* restore the shipped"):
            Expert.load(folder)
