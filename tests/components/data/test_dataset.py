"""Storage: layout, round trip, digest, and what damaged folders say."""

import json
from pathlib import Path

import numpy as np
import pytest

from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset, array_digest
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from tests.components.synthetic import make_log

SPEC = IndustrialSpec("mediocre-0.4", "mediocre", 0.4, trajectories=3, steps=120)


@pytest.fixture(scope="module")
def dataset() -> OfflineDataset:
    return generate(SPEC, seed=1)


@pytest.fixture
def folder(dataset: OfflineDataset, tmp_path: Path) -> Path:
    dataset.write(tmp_path / "stored")
    return tmp_path / "stored"


def test_layout(dataset: OfflineDataset) -> None:
    assert dataset.transitions == 360
    assert dataset.episodes == 3
    assert dataset.frames.shape == (363, 6)
    assert dataset.actions.shape == (360, 3)
    assert np.abs(dataset.actions).max() <= 1.0
    assert dataset.episode_starts.tolist() == [0, 120, 240, 360]
    assert np.flatnonzero(dataset.truncated).tolist() == [119, 239, 359]
    assert not dataset.terminated.any()
    assert dataset.frame_rows()[[0, 119, 120, 359]].tolist() == [0, 119, 121, 361]
    assert dataset.first_rows()[[0, 119, 120, 359]].tolist() == [0, 0, 121, 242]
    assert dataset.episode_index()[[0, 119, 120, 359]].tolist() == [0, 0, 1, 2]


def test_rows_pair_frames_actions_and_rewards(dataset: OfflineDataset) -> None:
    rows = dataset.frame_rows()
    now, following = dataset.frames[rows], dataset.frames[rows + 1]
    sizes = np.array([1.0, 10.0, 5.7515])
    expected = np.clip(now[:, 1:4] + sizes * dataset.actions, 0.0, 100.0)
    # float32 frames near 100, and a shift step given with five digits
    np.testing.assert_allclose(following[:, 1:4], expected, atol=1e-4)
    rewards = -(3.0 * following[:, 4] + following[:, 5]) / 100.0
    np.testing.assert_allclose(dataset.rewards, rewards, rtol=1e-5)  # float32
    starts = dataset.first_rows()[dataset.episode_starts[:-1]]
    assert (dataset.frames[starts, 1:4] == 50.0).all()


def test_round_trip(dataset: OfflineDataset, folder: Path) -> None:
    opened = OfflineDataset.open(folder)
    assert opened.card == dataset.card
    for name, array in dataset.arrays().items():
        stored = opened.arrays()[name]
        assert isinstance(stored, np.memmap)
        assert not stored.flags.writeable
        np.testing.assert_array_equal(stored, array)


def test_card_round_trip(dataset: OfflineDataset) -> None:
    card = dataset.card
    assert DatasetCard.from_json(card.to_json()) == card
    assert card.digest == array_digest(dataset.arrays())


def test_same_bytes_on_disk_for_the_same_seed(folder: Path, tmp_path: Path) -> None:
    generate(SPEC, seed=1).write(tmp_path / "again")
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "again").iterdir())
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_write_fills_an_empty_folder_and_refuses_a_used_one(
    dataset: OfflineDataset, tmp_path: Path
) -> None:
    target = tmp_path / "out"
    target.mkdir()
    dataset.write(target)
    with pytest.raises(ValueError, match="is not empty"):
        dataset.write(target)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_interrupted_write_leaves_nothing(
    dataset: OfflineDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(OSError, match="No space left"):
        dataset.write(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_missing_folder_and_files_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"card\.json is missing"):
        OfflineDataset.open(tmp_path / "nowhere")
    (folder / "rewards.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"rewards\.npy is missing"):
        OfflineDataset.open(folder)


def test_damaged_and_changed_arrays_are_refused(folder: Path) -> None:
    path = folder / "rewards.npy"
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ValueError, match="digest on their card"):
        OfflineDataset.open(folder)
    path.write_bytes(whole[:100])
    with pytest.raises(ValueError, match="damaged"):
        OfflineDataset.open(folder)
    np.save(path, np.zeros(360))
    with pytest.raises(ValueError, match="holds float64"):
        OfflineDataset.open(folder)


def test_arrays_that_do_not_fit_together_are_refused(folder: Path) -> None:
    np.save(folder / "actions.npy", np.zeros((5, 3), dtype=np.float32))
    with pytest.raises(ValueError, match=r"has the shape \(5, 3\), not \(360, 3\)"):
        OfflineDataset.open(folder, check=False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 99}, "format version is 99"),
        ({"colour": "red"}, "unknown fields"),
        (None, "is not JSON"),
    ],
)
def test_cards_that_cannot_be_read_say_why(
    change: dict[str, object] | None, message: str, folder: Path
) -> None:
    path = folder / "card.json"
    text = path.read_text()
    path.write_text("{" if change is None else json.dumps({**json.loads(text), **change}))
    with pytest.raises(ValueError, match=message):
        OfflineDataset.open(folder)


def test_cards_of_before_the_robots_are_read(dataset: OfflineDataset, folder: Path) -> None:
    path = folder / "card.json"
    values = json.loads(path.read_text())
    for name in ("controller_digest", "noise", "simulator", "transitions"):
        del values[name]
    path.write_text(json.dumps(values))
    assert OfflineDataset.open(folder).card == dataset.card
    del values["epsilon"]
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=r"unknown fields \(epsilon\)"):
        OfflineDataset.open(folder)


def test_observations_may_be_shortened_but_not_lengthened() -> None:
    log = make_log(history=3)
    assert log.with_history(2).card.history == 2
    assert log.with_history(0).card.history == 3
    assert log.with_history(2).frames is log.frames
    with pytest.raises(ValueError, match="history is 4, but observations of toy have 3 frames"):
        log.with_history(4)
