"""Stacked layers and random streams: the building blocks of every learner."""

from components.networks.stacked import (
    StackedLinear,
    StackedMLP,
    lanewise_mean,
    polyak_update,
    select_lanes,
)
from components.networks.streams import (
    Draw,
    LaneStreams,
    lane_generator,
    lane_key,
    spawn_generators,
)

__all__ = [
    "Draw",
    "LaneStreams",
    "StackedLinear",
    "StackedMLP",
    "lane_generator",
    "lane_key",
    "lanewise_mean",
    "polyak_update",
    "select_lanes",
    "spawn_generators",
]
