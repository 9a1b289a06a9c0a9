"""Settings of models and algorithms: out of range is refused, naming the field."""

import pytest

from components.algorithms import ALGORITHMS
from components.models import MODELS

CONFIGS = {name: kind.config for name, kind in MODELS.items()} | {
    name: algorithm.config for name, algorithm in ALGORITHMS.items()
}


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        ("behaviour_policy", "epochs", 0),
        ("behaviour_policy", "batch", 0),
        ("behaviour_policy", "hidden", (0,)),
        ("behaviour_policy", "learning_rate", 0.0),
        ("behaviour_policy", "holdout", 1.0),
        ("behaviour_policy", "schedule", "linear"),
        ("behaviour_policy", "weight_decay", -1e-3),
        ("gaussian_behaviour", "epochs", 0),
        ("gaussian_behaviour", "batch", 0),
        ("gaussian_behaviour", "hidden", (8, 0)),
        ("gaussian_behaviour", "action_clip", 1.0),
        ("gaussian_behaviour", "learning_rate", 0.0),
        ("gaussian_behaviour", "schedule", "linear"),
        ("gaussian_behaviour", "weight_decay", -1e-3),
        ("gaussian_behaviour", "holdout", 0.0),
        ("deterministic_ensemble", "members", 0),
        ("deterministic_ensemble", "elites", 5),
        ("deterministic_ensemble", "hidden", (400, 0)),
        ("deterministic_ensemble", "history", -1),
        ("deterministic_ensemble", "target", "delta"),
        ("deterministic_ensemble", "schedule", "linear"),
        ("gaussian_ensemble", "elites", 8),
        ("gaussian_ensemble", "patience", -1),
        ("gaussian_ensemble", "improvement", 1.0),
        ("gaussian_ensemble", "weight_decay", -1e-3),
        ("residual_ensemble", "epochs", 0),
        ("residual_ensemble", "batch", 0),
        ("residual_ensemble", "learning_rate", 0.0),
        ("residual_ensemble", "holdout", 1.0),
        ("recurrent_ensemble", "members", 0),
        ("recurrent_ensemble", "warm_up", 0),
        ("recurrent_ensemble", "horizon", 0),
        ("recurrent_ensemble", "networks", "both"),
        ("recurrent_ensemble", "target", "auto"),
        ("recurrent_ensemble", "patience", 0),
        ("recurrent_ensemble", "clip_norm", 0.0),
        ("recurrent_ensemble", "weight_decay", -1.0),
        ("recurrent_ensemble", "warm_fraction", 1.0),
        ("recurrent_ensemble", "holdout", 0.0),
        ("lion", "updates", 0),
        ("lion", "hidden", (256, 0)),
        ("lion", "horizon", 0),
        ("lion", "start_window", 0),
        ("lion", "start_after", 30),
        ("model_based", "start_after", -1),
        ("wsbc", "start_after", 1000),
        ("lion", "learning_rate", -1e-3),
        ("lion", "beta", 0.0),
        ("lion", "eta", -0.1),
        ("lion", "discount", 1.1),
        ("td3_bc", "batch", 0),
        ("td3_bc", "actor_every", 0),
        ("td3_bc", "discount", 1.0),
        ("td3_bc", "target_rate", 0.0),
        ("td3_bc", "alpha", -1.0),
        ("td3_bc", "smoothing", -0.1),
        ("td3_bc", "learning_rate", 0.0),
    ],
)
def test_values_out_of_range_are_refused(name: str, field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field):
        CONFIGS[name](**{field: value})


@pytest.mark.parametrize("name", CONFIGS)
def test_defaults_are_valid(name: str) -> None:
    CONFIGS[name]()
