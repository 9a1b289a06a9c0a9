"""What tests of sessions operate: policies whose actions are known, on real systems and logs."""

import dataclasses

import torch

from components.core.normaliser import Normaliser
from components.environments.systems import INDUSTRIAL_BENCHMARK
from components.operating.operable import Operable, familiar_frames
from components.policies.policy import PROXIMITY_SCALING, Policy
from tests.components.synthetic import FEATURES, constant_policy, make_log, policy_card

LOG = make_log(steps=30)
TURBINE = dataclasses.replace(
    LOG.card,
    environment=INDUSTRIAL_BENCHMARK.id,
    environment_parameters={"setpoint": 70.0},
    steps=12,
)


def dial() -> Policy:
    """A policy that takes the proximity: all actions are tanh of it, standardised."""
    weight = torch.zeros(1, len(FEATURES) * 3 + 1, 3)
    weight[:, -1] = 1.0
    scaling = Normaliser(torch.zeros(1, len(FEATURES)), torch.ones(1, len(FEATURES)))
    card = policy_card(takes_proximity=True, algorithm="lion")
    return Policy.of_networks(card, {"actor": [(weight, torch.zeros(1, 1, 3))]}, scaling)


def turned(proximity: float) -> float:
    """The action of :func:`dial`."""
    scaled = (torch.tensor([proximity]) - PROXIMITY_SCALING.mean) / PROXIMITY_SCALING.scale
    return float(torch.tanh(scaled))


def turbine(policy: Policy | None = None) -> Operable:
    """The real turbine under the dial, beside a behaviour that does nothing."""
    still = constant_policy([0.0, 0.0, 0.0])
    return Operable(policy or dial(), still, TURBINE, familiar_frames(LOG))


def recorded() -> Operable:
    """A log without a system."""
    return Operable(dial(), None, LOG.card, familiar_frames(LOG), LOG)
