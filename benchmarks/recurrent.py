"""Speed of the stacked scan: a training pass of the transition ensemble against a plain loop.

`python -m benchmarks.recurrent [--device cpu] [--repetitions 3]`. A pass is prediction, loss and
gradients of all networks at the window sizes of the ensemble's default configuration. The plain
loop is how a recurrent cell with an own feedback is commonly written in PyTorch: one network at a
time, one step at a time, `torch.tanh`, an own `nn.Parameter` per matrix, autograd through
everything. Both compute the same numbers; the tests hold losses and gradients against each other.
"""

import argparse
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from benchmarks.measure import computer, markdown, median_seconds
from components.models.recurrent_ensemble.ensemble import (
    Feedback,
    RecurrentEnsembleConfig,
    predict_windows,
)

__all__ = [
    "FATIGUE_ALONE",
    "PlainNetwork",
    "plain_networks",
    "plain_pass",
    "random_problem",
    "report",
    "stacked_pass",
]


KNOWN = 4
"""Known features of the Industrial Benchmark."""
FATIGUE_ALONE = Feedback.stored(torch.tensor([[1.0], [0.0]]), torch.zeros(2, 1))
"""The networks of fatigue read their own predictions back, those of consumption do not."""


class PlainNetwork(nn.Module):
    """One network of the ensemble, step by step."""

    def __init__(self, weight: Tensor, readout: Tensor, feeds_back: bool) -> None:
        """Takes over `weight [H, H + 6]` and `readout [1, H + 1]` of a stack's member.

        Args:
            weight: Columns hidden state, steerings, own previous value, bias.
            readout: Last column the bias.
            feeds_back: Whether its own prediction is the next input; else that input stays zero.
        """
        super().__init__()
        self.feeds_back = feeds_back
        width = weight.shape[0]
        self.recurrent = nn.Parameter(weight[:, :width].clone())
        self.inputs = nn.Parameter(weight[:, width:-1].clone())
        self.bias = nn.Parameter(weight[:, -1].clone())
        self.readout = nn.Parameter(readout[:, :-1].clone())
        self.offset = nn.Parameter(readout[:, -1].clone())

    def forward(self, windows: Tensor, warm_up: int) -> Tensor:
        """Predictions `[F, B]` after `warm_up` recorded steps of `windows [G + F, B, 5]`."""
        hidden = windows.new_zeros(windows.shape[1], self.recurrent.shape[0])
        predictions: list[Tensor] = []
        for step, window in enumerate(windows):
            steering, own = window[:, :KNOWN], window[:, KNOWN:]
            if self.feeds_back and step > warm_up:
                own = predictions[-1]
            x = torch.cat([steering, own], dim=1)
            hidden = torch.tanh(
                nn.functional.linear(hidden, self.recurrent)
                + nn.functional.linear(x, self.inputs, self.bias)
            )
            if step >= warm_up:
                predictions.append(nn.functional.linear(hidden, self.readout, self.offset))
        return torch.stack(predictions).squeeze(-1)


def random_problem(
    config: RecurrentEnsembleConfig, device: torch.device
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights `[M, H, H + 6]`, readouts `[M, 1, H + 1]`, windows `[T, M, 5, B]`, targets.

    As in the ensemble, the second half of the networks, those of consumption, has no own input.
    """
    generator = torch.Generator().manual_seed(0)
    cells, width = 2 * config.members, config.hidden
    steps = config.warm_up + config.horizon

    def uniform(*shape: int) -> Tensor:
        drawn = torch.rand(shape, generator=generator) * 2.0 - 1.0
        return (drawn * width**-0.5).to(device)

    windows = torch.randn(steps, cells, KNOWN + 1, config.batch, generator=generator)
    targets = torch.randn(config.horizon, cells, config.batch, generator=generator)
    weight, readout = uniform(cells, width, width + 6), uniform(cells, 1, width + 1)
    windows[:, config.members :, -1] = 0.0
    weight[config.members :, :, -2] = 0.0
    return weight, readout, windows.to(device), targets.to(device)


def plain_networks(weight: Tensor, readout: Tensor) -> list[PlainNetwork]:
    """The members of a stack, one by one."""
    fatigue = len(weight) // 2
    return [
        PlainNetwork(w, r, number < fatigue).to(w.device)
        for number, (w, r) in enumerate(zip(weight, readout, strict=True))
    ]


def stacked_pass(
    weight: Tensor,
    readout: Tensor,
    windows: Tensor,
    targets: Tensor,
    config: RecurrentEnsembleConfig,
) -> Tensor:
    """Losses `[M]` of all networks at once; gradients are left in `weight` and `readout`."""
    weight.grad = readout.grad = None
    predictions = predict_windows(weight, readout, windows, config.warm_up, FATIGUE_ALONE)
    losses = (predictions - targets).square().mean(dim=(0, 2))
    losses.sum().backward()
    return losses.detach()


def plain_pass(
    networks: Sequence[PlainNetwork], windows: Sequence[Tensor], targets: Tensor, warm_up: int
) -> Tensor:
    """Losses `[M]`, one network after the other; `windows` holds `[T, B, 5]` per network."""
    losses = []
    for number, network in enumerate(networks):
        network.zero_grad(set_to_none=True)
        predictions = network(windows[number], warm_up)
        loss = (predictions - targets[:, number]).square().mean()
        loss.backward()
        losses.append(loss.detach())
    return torch.stack(losses)


def report(
    device: str = "cpu",
    repetitions: int = 3,
    passes: int = 3,
    config: RecurrentEnsembleConfig | None = None,
) -> str:
    """Measure both; a Markdown table.

    Args:
        device: Where to compute.
        repetitions: Timings per row, the median counts.
        passes: Of each kind per timing.
        config: For the sizes; the default configuration if None.
    """
    sizes = config or RecurrentEnsembleConfig()
    place = torch.device(device)
    weight, readout, windows, targets = random_problem(sizes, place)
    networks = plain_networks(weight, readout)
    batch_major = [part.transpose(1, 2).contiguous() for part in windows.unbind(dim=1)]
    weight.requires_grad_()
    readout.requires_grad_()
    names = ("plain loop, one network at a time", f"stacked scan, {len(networks)} networks")

    def plain() -> None:
        for _ in range(passes):
            plain_pass(networks, batch_major, targets, sizes.warm_up)

    def stacked() -> None:
        for _ in range(passes):
            stacked_pass(weight, readout, windows, targets, sizes)

    seconds = median_seconds({names[0]: plain, names[1]: stacked}, repetitions)
    rows = []
    for name in names:
        whole = seconds[name] / passes
        one = whole / (len(networks) * sizes.batch)
        ratio = seconds[names[0]] / seconds[name]
        rows.append([name, f"{1e3 * whole:,.1f}", f"{1e6 * one:,.2f}", f"{ratio:.1f}"])
    columns = ["training pass", "ms per pass", "µs per window and network", "times faster"]
    return markdown(columns, rows) + (
        f"\n\n{sizes.batch} windows of {sizes.warm_up} + {sizes.horizon} steps per network, "
        f"{sizes.hidden} hidden units, float32."
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recurrent", description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    print(report(options.device, options.repetitions))
    print(f"\n{computer(options.device)}")


if __name__ == "__main__":
    main()
