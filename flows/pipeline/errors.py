"""Errors of a sweep rather than of one node, each one sentence with its remedy."""

__all__ = ["PipelineError", "StoreError", "TrackingError"]


class PipelineError(RuntimeError):
    """The sweep cannot go on; the message names the thing and the remedy."""


class StoreError(PipelineError):
    """The artifact store cannot be read or written."""


class TrackingError(PipelineError):
    """The tracker refused or could not be reached; artifacts on disk are not affected."""
