"""Policy artifacts: what is stored acts as before, and what is damaged says so."""

import json
import pickle
from pathlib import Path

import pytest
import torch
from torch import nn

from components.core.integrity import DamagedFileError
from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator
from components.core.tensors import load_tensors, save_tensors
from components.networks import StackedMLP
from components.policies.policy import PROXIMITY_SCALING, Policy
from tests.components.synthetic import (
    FEATURES,
    constant_policy,
    make_log,
    policy_card,
    random_policy,
)

LOG = make_log()
HISTORIES = torch.from_numpy(LOG.frames[: 2 * 7 * 3].reshape(2, 7, 3, 6).copy())


@pytest.fixture
def policy() -> Policy:
    return random_policy(LOG, ("a", "b"))


@pytest.fixture
def folder(policy: Policy, tmp_path: Path) -> Path:
    policy.save(tmp_path)
    return tmp_path


def test_acts_as_a_plain_network_on_scaled_histories(policy: Policy) -> None:
    actions = policy.act(HISTORIES)
    assert actions.shape == (2, 7, 3)
    mean, scale = policy.frames.mean, policy.frames.scale
    for lane in range(2):
        x = ((HISTORIES[lane] - mean[lane]) / scale[lane]).reshape(7, -1)
        (w1, b1), (w2, b2) = policy.layers
        hidden = nn.functional.relu(x @ w1[lane] + b1[lane])
        torch.testing.assert_close(actions[lane], torch.tanh(hidden @ w2[lane] + b2[lane]))


def test_stored_and_loaded_acts_the_same(policy: Policy, folder: Path) -> None:
    loaded = Policy.load(folder)
    assert loaded.card == policy.card
    assert torch.equal(loaded.act(HISTORIES), policy.act(HISTORIES))
    assert sorted(p.name for p in folder.iterdir()) == ["policy.json", "weights.safetensors"]


def test_lanes_and_concatenation(policy: Policy) -> None:
    parts = [policy.lane(n, policy.card) for n in (0, 1)]
    both = Policy.concatenate(policy.card, parts[::-1])
    assert both.lanes == 2
    for ours, theirs in zip(
        both.act(HISTORIES.flip(0)), policy.act(HISTORIES).flip(0), strict=True
    ):
        assert torch.equal(ours, theirs)


def test_a_copy_does_not_follow_the_network_it_came_from() -> None:
    network = StackedMLP([lane_generator(1)], (18, 3))
    like = random_policy(LOG, ("a",))
    policy = Policy.of_networks(like.card, {"actor": network.affine()}, like.frames)
    before = policy.act(HISTORIES[:1])
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(1.0)
    assert torch.equal(policy.act(HISTORIES[:1]), before)


def test_proximity_is_asked_for_exactly_where_it_is_taken(policy: Policy) -> None:
    with pytest.raises(ValueError, match="does not take proximity"):
        policy.act(HISTORIES, torch.zeros(2, 7))
    weight = torch.zeros(1, 19, 3)
    weight[0, 18, 1] = 1.0
    fixed = constant_policy([0.0, 0.0, 0.0])
    card = fixed.card.__class__(**(vars(fixed.card) | {"takes_proximity": True}))
    adaptive = Policy.of_networks(card, {"actor": [(weight, fixed.layers[0][1])]}, fixed.frames)
    with pytest.raises(ValueError, match="needs proximity"):
        adaptive.act(HISTORIES[:1])
    actions = adaptive.act(HISTORIES[:1, :3], torch.tensor([[0.0, 0.5, 1.0]]))
    expected = torch.tanh(torch.tensor([-0.5 / 0.2887, 0.0, 0.5 / 0.2887]))
    torch.testing.assert_close(actions[0, :, 1], expected)
    assert PROXIMITY_SCALING.apply(torch.tensor(0.5)) == 0.0


def test_missing_files_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no policy in .*empty: policy.json is missing"):
        Policy.load(tmp_path / "empty")
    (folder / "weights.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"weights\.safetensors does not exist"):
        Policy.load(folder)


def changed_card(folder: Path, **changes: object) -> str:
    values = json.loads((folder / "policy.json").read_text())
    return json.dumps({k: v for k, v in (values | changes).items() if v is not ...})


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"format": "policy/99"}, "its format is 'policy/99'"),
        ({"format": ...}, "its format is None"),
        ({"history": ...}, r"fields \(history\)"),
        ({"steps": ...}, r"fields \(steps\)"),
        ({"steps": 3}, "not iterable"),
        ({"invented": 1}, "invented"),
        ({"kind": "oracle"}, "it acts by 'oracle'"),
    ],
)
def test_cards_that_do_not_fit_are_refused(folder: Path, changes: dict, reason: str) -> None:
    (folder / "policy.json").write_text(changed_card(folder, **changes))
    with pytest.raises(ValueError, match=f"policy.json cannot be used .*{reason}.*train the"):
        Policy.load(folder)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"null", b"\xff\xfe"])
def test_damaged_cards_are_refused(folder: Path, content: bytes) -> None:
    (folder / "policy.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"policy\.json cannot be used .*train the policy again"):
        Policy.load(folder)


def test_a_card_that_was_changed_is_refused(folder: Path) -> None:
    path = folder / "policy.json"
    path.write_text(path.read_text() + " ")
    with pytest.raises(DamagedFileError, match=r"policy\.json is damaged .*train the policy again"):
        Policy.load(folder)


def test_damaged_weights_are_refused_and_nothing_is_unpickled(folder: Path) -> None:
    weights = folder / "weights.safetensors"
    whole = weights.read_bytes()
    mark = folder / "mark"

    class Trap:
        def __reduce__(self) -> tuple:
            return Path.touch, (mark,)

    for content in (whole[:-1], whole[:9], b"", pickle.dumps(Trap())):
        weights.write_bytes(content)
        with pytest.raises(ValueError, match=r"weights\.safetensors is damaged"):
            Policy.load(folder)
    assert not mark.exists()


def test_weights_without_a_layer_are_refused(policy: Policy, folder: Path) -> None:
    path = folder / "weights.safetensors"
    tensors, header = load_tensors(path)
    del tensors["actor.1.bias"]
    save_tensors(path, tensors, header)
    with pytest.raises(ValueError, match=r"weights\.safetensors lacks 'actor\.1\.bias'"):
        Policy.load(folder)


def test_the_card_says_what_the_policy_is(folder: Path) -> None:
    values = json.loads((folder / "policy.json").read_text())
    assert values["format"] == "policy/2"
    assert tuple(values["features"]) == FEATURES
    assert values["history"] == 3
    assert values["takes_lambda"] is False  # the stored name of takes_proximity
    assert "takes_proximity" not in values


def test_every_policy_may_scale_the_proximity_in_its_own_way() -> None:
    weight = torch.zeros(2, 19, 3)
    weight[:, 18, 0] = 1.0
    card = policy_card(takes_proximity=True, kind="clipped")
    scaling = Normaliser(torch.tensor([[0.0], [0.5]]), torch.tensor([[2.0], [-1.0]]))
    frames = Normaliser(torch.zeros(2, 6), torch.ones(2, 6))
    both = Policy.of_networks(card, {"actor": [(weight, torch.zeros(2, 1, 3))]}, frames, scaling)
    actions = both.act(HISTORIES[:, :2], torch.tensor([[0.0, 1.0]] * 2))
    assert actions[:, :, 0].tolist() == [[0.0, 0.5], [0.5, -0.5]]


def test_infinite_and_undefined_weights_are_told_per_policy(policy: Policy) -> None:
    assert policy.finite.tolist() == [True, True]
    policy.layers[1][1][1, 0, 2] = torch.nan
    assert policy.finite.tolist() == [True, False]


def test_undefined_policies_are_neither_written_nor_read(
    policy: Policy, folder: Path, tmp_path: Path
) -> None:
    policy.layers[1][1][1, 0, 2] = torch.inf
    (tmp_path / "new").mkdir()
    with pytest.raises(ValueError, match=r"^A policy of test on toy is not finite in actor\.1\.bi"):
        policy.save(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []
    path = folder / "weights.safetensors"
    tensors, header = load_tensors(path)
    tensors["frames.scale"][0, 1] = torch.nan
    save_tensors(path, tensors, header)
    with pytest.raises(ValueError, match=r"safetensors is not finite in frames\.scale; train the"):
        Policy.load(folder)
