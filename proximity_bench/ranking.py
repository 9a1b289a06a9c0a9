"""What logs promise, before anything is trained: the dataset indicators of thesis chapter 4."""

from collections.abc import Sequence

import pandas as pd

from components.core.random_streams import lane_key
from components.data.dataset import OfflineDataset
from components.data.indicators import log_facts, return_floor
from components.environments.systems import SYSTEMS
from components.models.action_stochasticity import StochasticityConfig, fit_action_stochasticity
from components.models.supervised import Monitor
from components.reporting.ranking import Measured, ranking_table
from components.training.memory import keep_freed_memory
from proximity_bench.progress import progress_bars
from proximity_bench.training import chosen_device

__all__ = ["rank"]


def rank(
    logs: OfflineDataset | Sequence[OfflineDataset],
    *,
    floor: float | None = None,
    device: str = "auto",
    progress: bool = True,
) -> pd.DataFrame:
    """Rank logs by what offline reinforcement learning can gain from them, see docs/ranking.md.

    Args:
        logs: One or several.
        floor: Return that none falls below, of all logs; by default that of the system where it is
            known, else every log's own least return.
        device: "cpu", "cuda", or "auto", a GPU where there is one.
        progress: Whether to show bars, one for each log.

    Returns:
        A row a log, the most promising first: `eri`, `eas`, their ranks and that of both combined,
        a sentence on what limits it, and a first guess of the proximities to try.

    Raises:
        ValueError: A log is too short, or its returns are not above the floor; one sentence.
    """
    several = [logs] if isinstance(logs, OfflineDataset) else list(logs)
    if not several:
        raise ValueError("There are no logs to be ranked; give one at least.")
    where, config = chosen_device(device), StochasticityConfig()
    keep_freed_memory()
    measured = []
    with progress_bars(progress) as begin:
        for log in several:
            facts, name = log_facts(log), log.card.name
            key = lane_key(name, "action_stochasticity")
            spread = fit_action_stochasticity(log, config, key, where, monitor=Monitor(begin(name)))
            measured.append(
                Measured(
                    facts,
                    return_floor(facts, floor),
                    spread.eas,
                    spread.expected,
                    generated=log.card.environment in SYSTEMS,
                )
            )
    return ranking_table(measured, None)
