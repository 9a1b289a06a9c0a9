"""Runs that killed processes left open in MLflow: whoever opens the store next closes them."""

from typing import Any

from flows.pipeline.tracking.sweep_lock import is_held

__all__ = ["close_leftovers", "delete_row"]


def close_leftovers(experiment: Any) -> None:
    """Closes the open runs of this store that no living process writes; the caller is alone.

    A node's run is written from beginning to end by a process that is alone, so an open one is half
    written. That of a trial or a row of the leaderboard is removed, because it is written again. A
    sweep's or search's own run is open for as long as its process holds the sweep's lock.

    Args:
        experiment: The MlflowExperiment.
    """
    client = experiment.client
    for run in list(experiment.search("attributes.status = 'RUNNING'")):
        tags = run.data.tags
        if not experiment.owns(tags):
            continue
        if tags.get("study"):
            client.delete_run(run.info.run_id)
        elif tags.get("role") == "row":
            delete_row(experiment, run)
        elif tags.get("role") == "node":
            client.set_terminated(run.info.run_id, "KILLED", end_time=run.info.start_time)
        elif tags.get("role") == "sweep" and not is_held(experiment.root, tags.get("sweep", "")):
            client.set_terminated(run.info.run_id, "KILLED", end_time=_last_sign(experiment, run))


def delete_row(experiment: Any, run: Any) -> None:
    """Deletes a row of the leaderboard and the model that was listed for it.

    Args:
        experiment: The MlflowExperiment of the leaderboard.
        run: The row's run.
    """
    client = experiment.client
    listed = f"tags.about = '{run.data.tags.get('about', '')}'"
    for model in client.search_logged_models([experiment.id], filter_string=listed):
        client.delete_logged_model(model.model_id)
    client.delete_run(run.info.run_id)


def _last_sign(experiment: Any, sweep: Any) -> int:
    """When a killed sweep was last seen alive, in milliseconds since 1970."""
    below = experiment.search(f"tags.`mlflow.parentRunId` = '{sweep.info.run_id}'")
    return max([sweep.info.start_time, *(run.info.end_time or 0 for run in below)])
