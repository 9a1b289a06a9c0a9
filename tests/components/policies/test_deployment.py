"""How policies act: every kind against plain loops, with noise as the only source of chance."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.random_streams import spawn_generators
from components.networks import Critics, StackedMLP
from components.policies.deployment import KINDS
from components.policies.policy import Policy
from tests.components.algorithms.plain import critic, floats, network
from tests.components.synthetic import FEATURES, keys, policy_card

HISTORY, ACTED, BATCH, CANDIDATES = 3, 3, 5, 6
SEEN = HISTORY * len(FEATURES)
NOISE = {"gaussian_candidates": ACTED, "perturbed_candidates": 2 * ACTED}
SHIFT = 0.7  # far more than BCQ's 0.05, so that it shows
every_kind = pytest.mark.parametrize("kind", KINDS)
choosing_kinds = pytest.mark.parametrize("kind", NOISE)


class Parts:
    """Networks of P policies of one kind, with outputs large enough to meet every clamp."""

    def __init__(self, kind: str, names: tuple[object, ...] = ("a", "b")) -> None:
        self.kind, self.names = kind, names
        sizes = {
            "gaussian_candidates": (SEEN, 7, 2 * ACTED),
            "perturbed_candidates": (SEEN + ACTED, 7, ACTED),
        }.get(kind, (SEEN, 7, ACTED))
        self.actor = StackedMLP(spawn_generators(keys(*names), "actor"), sizes)
        self.decoder = StackedMLP(
            spawn_generators(keys(*names), "decoder"), (SEEN + 2 * ACTED, 8, 7, ACTED)
        )
        self.critics = Critics(keys(*names), SEEN, ACTED, (9, 8))
        with torch.no_grad():
            for stack in (self.actor, self.decoder):
                for parameter in stack.parameters():
                    parameter.mul_(2.5)

    def policy(self) -> Policy:
        networks = {"actor": self.actor.affine()}
        settings: dict[str, object] = {}
        if self.kind in NOISE:
            networks["critic"] = self.critics.first_network()
            settings = {"candidates": CANDIDATES, "noise": NOISE[self.kind]}
        if self.kind == "perturbed_candidates":
            networks["decoder"] = self.decoder.affine()
            settings["perturbation"] = SHIFT
        ones = torch.ones(len(self.names), len(FEATURES))
        card = policy_card(kind=self.kind, steps=tuple(range(len(self.names))), **settings)
        return Policy.of_networks(card, networks, Normaliser(0.0 * ones, ones))

    def candidates(self, lane: int, seen: np.ndarray, noise: np.ndarray) -> list[np.ndarray]:
        """All actions drawn at one observation, one after the other."""
        if self.kind == "gaussian_candidates":
            out = network(self.actor, lane, seen[None])[0]
            mean, std = out[:ACTED], np.exp(np.clip(out[ACTED:], -5.0, 2.0))
            return [np.tanh(mean + std * n) for n in noise]
        drawn = []
        for n in noise:
            latent = np.clip(n, -0.5, 0.5)
            action = np.tanh(network(self.decoder, lane, np.concatenate([seen, latent])[None])[0])
            moved = network(self.actor, lane, np.concatenate([seen, action])[None])[0]
            drawn.append(np.clip(action + SHIFT * np.tanh(moved), -1.0, 1.0))
        return drawn


def seen_frames(policies: int = 2) -> Tensor:
    shape = (policies, BATCH, HISTORY, len(FEATURES))
    return torch.randn(shape, generator=torch.Generator().manual_seed(0))


def noise_of(kind: str, policies: int = 2, seed: int = 1) -> Tensor | None:
    if kind not in NOISE:
        return None
    shape = (policies, BATCH, CANDIDATES, NOISE[kind])
    return 1.5 * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@choosing_kinds
def test_the_first_critics_favourite_candidate_is_chosen(kind: str) -> None:
    parts = Parts(kind)
    x, noise = seen_frames(), noise_of(kind)
    actions = parts.policy().act(x, noise=noise)
    assert actions.shape == (2, BATCH, ACTED)
    chosen, second_would_choose = [], []
    for lane, i in np.ndindex(2, BATCH):
        seen = floats(x)[lane, i].reshape(-1)
        drawn = parts.candidates(lane, seen, floats(noise)[lane, i])
        values, others = (
            [critic(parts.critics.stack, 2 * lane + j, seen, action) for action in drawn]
            for j in range(2)
        )
        best = int(np.argmax(values))
        # far above float32's rounding, so that the choice is clear
        assert sorted(values)[-1] - sorted(values)[-2] > 1e-5
        # float32 through two or three networks
        np.testing.assert_allclose(floats(actions)[lane, i], drawn[best], atol=1e-4)
        chosen.append(best)
        second_would_choose.append(int(np.argmax(others)))
    assert len(set(chosen)) > 2
    assert chosen != second_would_choose


def test_deterministic_kinds_squash_or_clip_the_actors_output() -> None:
    x = seen_frames()
    for kind, bounded in (("tanh", np.tanh), ("clipped", lambda out: np.clip(out, -1.0, 1.0))):
        parts = Parts(kind)
        actions = parts.policy().act(x)
        for lane in range(2):
            out = network(parts.actor, lane, floats(x)[lane].reshape(BATCH, -1))
            assert np.abs(out).max() > 1.0  # or clipping would not show
            np.testing.assert_allclose(floats(actions)[lane], bounded(out), atol=1e-5)  # float32


def test_tanh_between_the_layers_by_a_plain_loop() -> None:
    parts, x = Parts("clipped_tanh_layers"), seen_frames()
    actions, beyond = parts.policy().act(x), 0
    for lane, i in np.ndindex(2, BATCH):
        seen = floats(x)[lane, i].reshape(-1)
        (inner, bias), (outer, last) = (
            (floats(w)[lane], floats(b)[lane, 0]) for w, b in parts.actor.affine()
        )
        hidden = [math.tanh(sum(seen * inner[:, h]) + bias[h]) for h in range(len(bias))]
        for d in range(ACTED):
            out = last[d] + sum(h * outer[n, d] for n, h in enumerate(hidden))
            beyond += abs(out) > 1.0
            # two layers in float32
            assert actions[lane, i, d].item() == pytest.approx(max(-1.0, min(1.0, out)), abs=1e-5)
    assert 0 < beyond < 2 * BATCH * ACTED, "some actions must be clipped and some must not"


@every_kind
def test_actions_stay_in_the_box(kind: str) -> None:
    parts = Parts(kind)
    with torch.no_grad():
        for stack in (parts.actor, parts.decoder):
            for parameter in stack.parameters():
                parameter.mul_(100.0)
    actions = parts.policy().act(50.0 * seen_frames(), noise=noise_of(kind))
    assert actions.abs().max() == 1.0


def test_latents_are_clamped_and_shifts_bounded() -> None:
    parts = Parts("perturbed_candidates")
    policy = parts.policy()
    far = torch.full((2, BATCH, CANDIDATES, 2 * ACTED), 30.0)
    x = seen_frames()
    assert torch.equal(policy.act(x, noise=far), policy.act(x, noise=0.5 * far.sign()))
    assert not torch.equal(policy.act(x, noise=far), policy.act(x, noise=0.4 * far.sign()))
    with torch.no_grad():
        weight, bias = parts.actor.affine()[-1]
        bias.fill_(100.0)
        weight.zero_()
        for parameter in parts.decoder.parameters():
            parameter.zero_()
    # tanh(0) shifted as far as allowed
    torch.testing.assert_close(
        parts.policy().act(x, noise=far), torch.full((2, BATCH, ACTED), SHIFT)
    )


@every_kind
def test_noise_is_asked_for_exactly_where_it_is_taken(kind: str) -> None:
    policy, x = Parts(kind).policy(), seen_frames()
    if kind in NOISE:
        with pytest.raises(ValueError, match="needs noise"):
            policy.act(x)
        with pytest.raises(ValueError, match="drawn from noise"):
            KINDS[kind](policy.networks, x.flatten(2), None, SHIFT)
    else:
        with pytest.raises(ValueError, match="does not take noise"):
            policy.act(x, noise=torch.zeros(2, BATCH, CANDIDATES, ACTED))


@every_kind
def test_a_stack_acts_as_each_policy_alone(kind: str) -> None:
    x, noise = seen_frames(3), noise_of(kind, 3)
    together = Parts(kind, ("a", "b", "c")).policy().act(x, noise=noise)
    for lane, name in enumerate("abc"):
        own = slice(lane, lane + 1)
        policy = Parts(kind, (name,)).policy()
        alone = policy.act(x[own], noise=None if noise is None else noise[own])
        # batched products may be summed in another order in float32
        torch.testing.assert_close(together[own], alone, rtol=1e-5, atol=1e-5)


@every_kind
def test_deeds_depend_on_nothing_but_frames_and_noise(kind: str) -> None:
    policy, x, noise = Parts(kind).policy(), seen_frames(), noise_of(kind)
    given = x.clone(), None if noise is None else noise.clone()
    torch.manual_seed(0)
    first = policy.act(x, noise=noise)
    torch.manual_seed(1)
    assert torch.equal(policy.act(x, noise=noise), first)
    assert torch.equal(x, given[0])
    if noise is not None:
        assert torch.equal(noise, given[1])
        assert not torch.equal(policy.act(x, noise=noise_of(kind, seed=2)), first)


@choosing_kinds
def test_an_undefined_critic_does_not_crash_and_leaves_its_neighbours_alone(kind: str) -> None:
    parts, x, noise = Parts(kind), seen_frames(), noise_of(kind)
    before = parts.policy().act(x, noise=noise)
    with torch.no_grad():
        parts.critics.stack.affine()[-1][1][0] = torch.nan  # the first lane's first critic
    after = parts.policy().act(x, noise=noise)
    assert torch.equal(after[1], before[1])
    for i in range(BATCH):  # no candidate is better than another: the first one
        seen = floats(x)[0, i].reshape(-1)
        first = parts.candidates(0, seen, floats(noise)[0, i])[0]
        np.testing.assert_allclose(floats(after)[0, i], first, atol=1e-4)  # float32


@pytest.mark.parametrize("infinite", [torch.inf, -torch.inf])
def test_an_undefined_value_loses_to_any_other(infinite: float) -> None:
    # One hidden unit, active at candidates with a positive first entry: there the value is
    # infinite, elsewhere 0 times infinity.
    entries = torch.tensor([-0.5, -0.2, 0.3, -0.1])
    width = len(FEATURES)
    actor = torch.zeros(1, width, 2), torch.tensor([[[0.0, -5.0]]])  # mean 0, deviation e^-5
    inner = torch.zeros(1, width + 1, 1)
    inner[0, -1] = 1.0
    nothing = torch.zeros(1, 1, 1)
    critic_layers = (inner, nothing), (torch.full((1, 1, 1), infinite), nothing)
    networks = {"actor": (actor,), "critic": critic_layers}
    noise = (torch.atanh(entries) * np.exp(5.0)).view(1, 1, 4, 1)
    chosen = KINDS["gaussian_candidates"](networks, torch.zeros(1, 1, width), noise, 0.0)
    assert chosen.item() == pytest.approx(0.3, abs=1e-5)  # float32
