"""Networks of several lanes side by side: stacked layers, critics, Gaussian and recurrent ones.

In: widths, and one random generator per lane. Out: modules whose parameters have the lane axis
first; a lane's numbers do not depend on its neighbours.
"""

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
    "StackedLinear",
    "StackedMLP",
    "TanhGaussian",
    "lane_groups",
    "lanewise_mean",
    "polyak_update",
    "select_lanes",
    "soft_clipped_maximum",
]
