"""Stacked layers and random streams: the building blocks of every learner."""

from components.core.random_streams import (
    Draw,
    LaneStreams,
    lane_generator,
    lane_key,
    normal_draw,
    spawn_generators,
)
from components.networks.critics import Critics, soft_clipped_maximum
from components.networks.gaussian import TanhGaussian
from components.networks.stacked import (
    StackedLinear,
    StackedMLP,
    lane_groups,
    lanewise_mean,
    polyak_update,
    select_lanes,
)

__all__ = [
    "Critics",
    "Draw",
    "LaneStreams",
    "StackedLinear",
    "StackedMLP",
    "TanhGaussian",
    "lane_generator",
    "lane_groups",
    "lane_key",
    "lanewise_mean",
    "normal_draw",
    "polyak_update",
    "select_lanes",
    "soft_clipped_maximum",
    "spawn_generators",
]
