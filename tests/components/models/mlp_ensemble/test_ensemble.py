"""One-step ensembles: bounds of the variance, virtual trajectories against plain loops, storage."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.tensors import save_tensors
from components.data.dynamics import DynamicsSpecification
from components.models.mlp_ensemble.ensemble import MLPEnsemble, MLPTransition, bounded_log_variance
from components.models.transition.model_environment import ModelEnvironment, Propagation
from tests.components.models.plain import doubles, trajectory
from tests.components.synthetic import CPU, make_log, random_mlp_ensemble

LOG = make_log()
RULE = DynamicsSpecification.of_card(LOG.card)
STEPS, BATCH = 7, 5
HISTORY = torch.from_numpy(LOG.frames[: 2 * BATCH * 3].reshape(2, BATCH, 3, 6).copy())
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, 3)).astype(np.float32)


def ensembles(gaussian: bool = False, **changes: object) -> list[MLPEnsemble]:
    """Two lanes that differ in everything they may, the first in values, the other in changes."""
    one, other = (random_mlp_ensemble(LOG, name, gaussian=gaussian) for name in "ab")
    moved = Normaliser(other.frames.mean + 2.0, 1.3 * other.frames.scale)
    one = dataclasses.replace(
        one, target="value", target_mean=torch.zeros(2), target_scale=torch.ones(2)
    )
    other = dataclasses.replace(other, frames=moved)
    return [dataclasses.replace(e, **changes) for e in (one, other)]


def narrowed(ensemble: MLPEnsemble, history: int) -> MLPEnsemble:
    """The ensemble, reading fewer frames."""
    (weight, bias), *others = ensemble.layers
    kept = torch.cat([weight[:, : history * 6], weight[:, -4:]], dim=1)
    return dataclasses.replace(ensemble, layers=((kept, bias), *others), history=history)


def unrolled(
    lanes: Sequence[MLPEnsemble], propagation: Propagation, noise: Tensor | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Rewards ``[T, L, N]`` and raw next frames ``[T, L, N, F]``; policies have a scaling."""
    scaling = Normaliser.stack(
        [Normaliser(e.frames.mean - 7.0, 0.8 * e.frames.scale) for e in lanes]
    )
    machine = ModelEnvironment(MLPTransition(lanes, scaling, CPU), RULE, scaling, CPU)
    actions = iter(torch.from_numpy(ACTIONS))
    steps = list(
        machine.unroll(
            ((HISTORY - scaling.mean[:, None, None]) / scaling.scale[:, None, None]).flatten(2),
            HISTORY,
            lambda seen: next(actions).expand(*seen.shape[:2], -1),
            STEPS,
            propagation,
            noise,
        )
    )
    frames = torch.stack([s.frames for s in steps])
    raw = frames * scaling.scale[:, None] + scaling.mean[:, None]
    return doubles(torch.stack([s.rewards for s in steps])), doubles(raw)


def compare(found: tuple[np.ndarray, np.ndarray], expected: tuple[np.ndarray, np.ndarray]) -> None:
    # seven steps of float32, in features of up to a hundred
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-4)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("history", [1, 3])
@pytest.mark.parametrize("gaussian", [False, True])
def test_the_least_rewarded_member_is_followed_as_in_a_plain_loop(
    gaussian: bool, history: int
) -> None:
    lanes = [narrowed(e, history) for e in ensembles(gaussian)]
    rewards, frames = unrolled(lanes, "minimum")
    chosen = set()

    def least(step: int, of_members: np.ndarray) -> int:
        chosen.add((lane, int(of_members.argmin())))
        return int(of_members.argmin())

    for lane, b in itertools.product(range(2), range(BATCH)):
        expected = trajectory(
            lanes[lane], HISTORY[lane, b].numpy(), ACTIONS, least, np.zeros((STEPS, 2))
        )
        compare((rewards[:, lane, b], frames[:, lane, b]), expected)
    assert len(chosen) > 2, "the choice must vary for this test to say something"


@pytest.mark.parametrize("gaussian", [False, True])
def test_isolated_members_go_their_own_ways_as_in_a_plain_loop(gaussian: bool) -> None:
    lanes = [narrowed(e, 2) for e in ensembles(gaussian)]
    rewards, frames = unrolled(lanes, "isolated")
    assert rewards.shape == (STEPS, 2, 3 * BATCH)
    for lane, member, b in itertools.product(range(2), range(3), range(BATCH)):
        expected = trajectory(
            lanes[lane],
            HISTORY[lane, b].numpy(),
            ACTIONS,
            lambda step, of_members, k=member: k,
            np.zeros((STEPS, 2)),
        )
        n = member * BATCH + b
        compare((rewards[:, lane, n], frames[:, lane, n]), expected)


def test_frames_are_drawn_from_the_named_members_gaussians() -> None:
    wide = {"low": torch.full((2,), -9.0), "high": torch.full((2,), 9.0)}
    lanes = ensembles(gaussian=True, **wide)
    rng = np.random.default_rng(1)
    numbers = rng.integers(3, size=(STEPS, 2, BATCH))
    noise = rng.normal(size=(STEPS, 2, 2, BATCH)).astype(np.float32)  # [T, L, D, B]
    rewards, frames = unrolled(lanes, torch.from_numpy(numbers), torch.from_numpy(noise))
    without, _ = unrolled(lanes, torch.from_numpy(numbers))
    assert np.abs(rewards - without).min() > 1e-4, "every step must have been drawn"
    for lane, b in itertools.product(range(2), range(BATCH)):
        expected = trajectory(
            lanes[lane],
            HISTORY[lane, b].numpy(),
            ACTIONS,
            lambda step, of_members, row=numbers[:, lane, b]: row[step],
            noise[:, lane, :, b],
        )
        compare((rewards[:, lane, b], frames[:, lane, b]), expected)


def test_lanes_of_a_stack_must_be_of_one_shape() -> None:
    one, other = ensembles()
    scaling = Normaliser.stack([one.frames, other.frames])
    for wrong in (
        narrowed(other, 2),
        dataclasses.replace(other, activation="swish"),
        dataclasses.replace(other, elites=(0, 1)),
        random_mlp_ensemble(LOG, "g", gaussian=True),
        random_mlp_ensemble(LOG, "m", members=2),
    ):
        with pytest.raises(ValueError, match="ensembles of equal members, layers, history"):
            MLPTransition([one, wrong], scaling, CPU)


def test_elites_of_all_lanes_are_at_hand() -> None:
    one, other = ensembles()
    lanes = [dataclasses.replace(one, elites=(2, 0)), dataclasses.replace(other, elites=(1, 2))]
    model = MLPTransition(lanes, Normaliser.stack([e.frames for e in lanes]), CPU)
    assert model.elites.tolist() == [[2, 0], [1, 2]]
    assert torch.equal(model.target_scale, torch.tensor([[1.0, 1.0], [0.3, 0.4]]))


def test_bounds_of_log_variances_by_hand() -> None:
    def by_hand(raw: float, low: float, high: float) -> float:
        below = high - math.log1p(math.exp(high - raw))
        return low + math.log1p(math.exp(below - low))

    for raw, low, high in [(0.0, -10.0, 0.5), (-9.5, -10.0, 0.5), (3.0, -2.0, 1.0)]:
        found = bounded_log_variance(*(torch.tensor([x]).double() for x in (raw, low, high)))
        assert float(found) == pytest.approx(by_hand(raw, low, high), rel=1e-12)  # doubles
    ends = bounded_log_variance(
        torch.tensor([-1e3, 1e3, -5.0]), torch.tensor(-10.0), torch.tensor(0.5)
    )
    # both ends are reached from inside, to the other's far tail e^-10.5; in between nothing changes
    # but by the tails e^-5 and e^-5.5
    assert ends.tolist() == pytest.approx([-10.0, 0.5, -5.0], abs=0.01)


@pytest.mark.parametrize("gaussian", [False, True])
def test_storage_keeps_every_number(gaussian: bool, tmp_path: Path) -> None:
    _, ensemble = ensembles(gaussian, elites=(1, 0))
    ensemble.save(tmp_path)
    found = MLPEnsemble.load(tmp_path)
    for field in dataclasses.fields(ensemble):
        ours, theirs = getattr(found, field.name), getattr(ensemble, field.name)
        if isinstance(theirs, Tensor):
            assert torch.equal(ours, theirs), field.name
        elif field.name == "layers":
            assert len(ours) == len(theirs)
            assert all(
                torch.equal(a, b)
                for one, other in zip(ours, theirs, strict=True)
                for a, b in zip(one, other, strict=True)
            )
        elif field.name == "frames":
            assert torch.equal(ours.mean, theirs.mean)
            assert torch.equal(ours.scale, theirs.scale)
        else:
            assert ours == theirs, field.name


def test_a_foreign_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"ensemble\.safetensors"):
        MLPEnsemble.load(tmp_path)
    save_tensors(
        tmp_path / "ensemble.safetensors", {"x": torch.ones(1)}, {"format": "recurrent-ensemble/1"}
    )
    with pytest.raises(ValueError, match=r"recurrent-ensemble/1.*expected 'mlp-ensemble/2'"):
        MLPEnsemble.load(tmp_path)
    (tmp_path / "ensemble.safetensors").write_bytes(b"\x80\x04K\x01.")  # a pickle
    with pytest.raises(ValueError, match="damaged or was not written by this project"):
        MLPEnsemble.load(tmp_path)
