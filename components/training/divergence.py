"""Training that leaves nothing: no state was finite, so there is nothing to store."""

__all__ = ["DivergedError"]


class DivergedError(ValueError):
    """Training diverged before it reached a state worth keeping.

    The message says of what and when, and starts and ends like the middle of a sentence: whoever
    knows the settings adds the name of the training and the remedy.
    """
