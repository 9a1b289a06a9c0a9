"""Training that leaves nothing: no state was finite, so there is nothing to store."""

from collections.abc import Mapping
from typing import Any

__all__ = ["DivergedError", "diverged"]


class DivergedError(ValueError):
    """Training diverged before it reached a state worth keeping.

    The message says of what and when, and starts and ends like the middle of a sentence: whoever
    knows the settings adds the name of the training and the remedy.
    """


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
