"""What the settings of a log follow from its card, where it has no file of its own yet."""

from dataclasses import fields
from typing import Any

from components.data.card import DatasetCard
from components.environments.systems import SYSTEMS
from flows.configuration.defaults import ALGORITHM_CONFIGS
from flows.configuration.files import PLANT

__all__ = ["settings_of_log"]


def settings_of_log(card: DatasetCard) -> dict[str, Any]:
    """Settings of a log of somebody else's, as in a file of conf/dataset.

    A plant that is not registered here is in the domain of plants, and learners value the future as
    the returns on the card do. Logs of a registered system are left as they are.
    """
    if card.environment in SYSTEMS:
        return {}
    algorithms = {}
    for name, kind in ALGORITHM_CONFIGS.items():
        gammas = [f for f in fields(kind) if f.name.endswith("discount")]
        if changed := {f.name: card.discount for f in gammas if f.default != card.discount}:
            algorithms[name] = changed
    return {"domain": PLANT} | ({"algorithm": algorithms} if algorithms else {})
