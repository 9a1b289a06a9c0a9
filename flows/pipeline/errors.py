"""What can go wrong in a sweep by no fault of a node, each as one sentence with its remedy."""

__all__ = ["PipelineError", "StoreError", "TrackingError"]


class PipelineError(RuntimeError):
    """The sweep cannot go on; the message names the thing and the remedy."""


class StoreError(PipelineError):
    """The artifact store cannot be read or written."""


class TrackingError(PipelineError):
    """MLflow refused or could not be reached; no artifact on disk is lost by that."""
