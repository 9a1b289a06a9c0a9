"""What a node says whose training diverged."""

from collections.abc import Mapping
from typing import Any

__all__ = ["diverged"]


def diverged(what: str, error: Exception, section: str, settings: Mapping[str, Any]) -> str:
    """One sentence with the settings that may be lowered.

    Args:
        what: The training, e.g. "The fit of behaviour_policy on mediocre-0.2".
        error: What became of it.
        section: Key of the settings on the command line, e.g. "model.behaviour_policy".
        settings: By name.
    """
    rates = [name for name in settings if name.endswith("learning_rate")]
    values = [f"{section}.{name} (now {settings[name]:g})" for name in rates]
    remedy = f"lower {' or '.join(values)}" if values else f"choose other settings of {section}"
    return f"{what} diverged: {error}; {remedy}."
