"""Natural policy gradients of Gaussian policies, on stacked lanes.

Kakade, "A natural policy gradient" (2001), in the form of Rajeswaran et al. (2017): the ascent
direction ``x`` solves ``(F + damping I) x = g`` by conjugate gradients, where ``g`` is the gradient
of the surrogate objective and ``F`` the Hessian of the mean KL divergence from the current policy.
For a Gaussian whose deviations do not depend on the state that Hessian is exactly the Gauss-Newton
matrix ``mean J^T diag(1 / std^2) J`` of the means and 2 for each log deviation: it is never formed,
only multiplied with vectors. The step ``sqrt(size / (g x)) x`` makes the damped quadratic model of
the divergence ``size / 2``, whatever the scale of ``g``.

A lane is a row: every vector is ``[L, P]``, every scalar of the iteration ``[L]``, so no lane's
length or curvature enters another's step.
"""

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor, nn

from components.core.random_streams import spawn_generators
from components.networks import StackedMLP

__all__ = [
    "LOG_STD_RANGE",
    "FisherProduct",
    "GaussianPolicy",
    "conjugate_gradients",
    "natural_step",
    "policy_gradient",
]

LOG_STD_RANGE = (-2.0, 1.0)
_TINY = 1e-20  # keeps a lane without any gradient from dividing by zero


class GaussianPolicy(nn.Module):
    """L policies ``u ~ N(mean(s), std^2)``, not squashed, with the same deviations in every state.

    Args:
        keys: One random stream per lane.
        sizes: Observation width, hidden widths, action width; tanh in between.
        log_std: Initial log standard deviation.
    """

    def __init__(self, keys: Sequence[int], sizes: Sequence[int], log_std: float) -> None:
        super().__init__()
        self.stack = StackedMLP(spawn_generators(keys, "actor"), sizes, torch.tanh_)
        self.log_std = nn.Parameter(torch.full((len(keys), 1, sizes[-1]), log_std))
        with torch.no_grad():
            for parameter in self.stack.affine()[-1]:
                parameter.mul_(0.01)  # means near 0 in all states at first

    def forward(self, observations: Tensor) -> Tensor:
        """Means ``[L, B, A]``."""
        mean: Tensor = self.stack(observations)
        return mean

    def draw(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Actions ``[L, B, A]`` from standard normal noise of that shape."""
        mean: Tensor = self(observations)
        return mean + self.log_std.exp() * noise

    def advance(self, step: Tensor) -> None:
        """Add ``step [L, P]`` to the parameters and keep the deviations in their range."""
        with torch.no_grad():
            for parameter, move in zip(self.vector(), _like(step, self.vector()), strict=True):
                parameter.add_(move)
            self.log_std.clamp_(*LOG_STD_RANGE)

    def vector(self) -> list[Tensor]:
        """Parameters in the order in which they make up a vector ``[L, P]``: log_std last."""
        return [*self.stack.parameters(), self.log_std]


def policy_gradient(
    policy: GaussianPolicy, samples: Iterable[tuple[Tensor, Tensor, Tensor]]
) -> Tensor:
    """Gradient ``[L, P]`` of ``sum_n w_n log pi(u_n | s_n)`` at the policy that drew the ``u_n``.

    Args:
        policy: L policies.
        samples: Portions of observations ``[L, N, O]``, the noise ``[L, N, A]`` from which the
            actions were drawn, and weights ``[L, N]``; the sum over all portions is taken.

    Raises:
        ValueError: There are no samples.
    """
    total: Tensor | None = None
    for observations, noise, weights in samples:
        mean = policy(observations)
        raw = (mean + policy.log_std.exp() * noise).detach()
        # Up to a constant, which has no gradient.
        log_density = -0.5 * ((raw - mean) * (-policy.log_std).exp()).square() - policy.log_std
        objective = (weights * log_density.sum(dim=-1)).sum()
        gradient = _flat(torch.autograd.grad(objective, policy.vector()))
        total = gradient if total is None else total + gradient
    if total is None:
        raise ValueError("A gradient needs samples.")
    return total


class FisherProduct:
    """Products of the Fisher matrices of L policies with vectors ``[L, P]``.

    ``J v`` is the derivative, with respect to ``w``, of ``(J^T w) v``: two backward passes through
    one forward pass that all products share.

    Args:
        policy: L policies.
        observations: ``[L, N, O]`` over which the divergence is averaged.
    """

    def __init__(self, policy: GaussianPolicy, observations: Tensor) -> None:
        *self._network, log_std = policy.vector()
        self._mean = policy(observations)
        self._probe = torch.zeros_like(self._mean, requires_grad=True)
        self._pulled = torch.autograd.grad(
            self._mean, self._network, self._probe, create_graph=True
        )
        self._weight = torch.exp(-2.0 * log_std.detach()) / observations.shape[1]
        self._vector = policy.vector()

    def __call__(self, vector: Tensor) -> Tensor:
        """``F v`` for every lane's ``v``."""
        *moves, spread = _like(vector, self._vector)
        [pushed] = torch.autograd.grad(self._pulled, self._probe, moves, retain_graph=True)
        back = torch.autograd.grad(
            self._mean, self._network, self._weight * pushed, retain_graph=True
        )
        return _flat([*back, 2.0 * spread])


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], target: Tensor, iterations: int, tolerance: float = 1e-10
) -> Tensor:
    """Solve ``A x = target`` for L symmetric positive definite matrices, from ``x = 0``.

    Args:
        product: ``A v`` for ``v [L, P]``.
        target: ``[L, P]``.
        iterations: At most; a lane stops once its squared residual has fallen below
            ``tolerance`` times its target's square.
        tolerance: Relative, of the squared residual.

    Returns:
        ``[L, P]``.
    """
    solution, residual, direction = torch.zeros_like(target), target, target
    square = _dot(residual, residual)
    limit = tolerance * square
    for _ in range(iterations):
        image = product(direction)
        active = square > limit
        length = torch.where(active, square / _dot(direction, image), 0.0)[:, None]
        solution = solution + length * direction
        residual = residual - length * image
        previous, square = square, _dot(residual, residual)
        direction = residual + torch.where(active, square / previous, 0.0)[:, None] * direction
    return solution


def natural_step(
    product: Callable[[Tensor], Tensor],
    gradient: Tensor,
    *,
    size: float,
    damping: float,
    iterations: int,
) -> Tensor:
    """The step ``[L, P]`` up ``gradient`` whose quadratic divergence is ``size / 2``.

    Args:
        product: ``F v``.
        gradient: ``g [L, P]``; a lane without any stays where it is.
        size: Twice the divergence.
        damping: Added to the diagonal of F.
        iterations: Of conjugate gradients. From zero, every iterate has ``g x = x (F + damping) x``
            exactly, so the length is right however early they end.
    """
    direction = conjugate_gradients(lambda v: product(v) + damping * v, gradient, iterations)
    slope = _dot(gradient, direction).clamp(min=_TINY)
    return (size / slope).sqrt()[:, None] * direction


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products ``[L]`` of rows."""
    return (a * b).sum(dim=1)


def _flat(tensors: Sequence[Tensor]) -> Tensor:
    """Lane-first tensors as rows ``[L, P]``."""
    return torch.cat([t.flatten(1) for t in tensors], dim=1)


def _like(vector: Tensor, tensors: Sequence[Tensor]) -> list[Tensor]:
    """Rows ``[L, P]`` cut into the shapes of ``tensors``."""
    parts = vector.split([t[0].numel() for t in tensors], dim=1)
    return [part.view_as(t) for part, t in zip(parts, tensors, strict=True)]
