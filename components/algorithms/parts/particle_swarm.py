"""Particle swarm optimisation inside a box, L swarms side by side (thesis 2.6).

N particles search for the position of largest fitness without any gradient. Each stores its best
position ``b`` so far, and reads the best one ``n`` of its neighbours on a ring. A move is

    v <- w v + c1 r1 (b - x) + c2 r2 (n - x)    with r1, r2 ~ U(0, 1) per entry     (2.57)
    v <- min(max(v, -v_max), v_max)             v_max: a share of half the box      (2.56)
    x <- min(max(x + v, low), high)                                                 (2.55, 5.20)

Velocities begin at zero. The caller evaluates the positions and draws the random numbers.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

__all__ = ["Swarm", "SwarmRule"]


@dataclass(frozen=True)
class SwarmRule:
    """How particles move.

    Attributes:
        neighbourhood: Particles of a ring neighbourhood, as many on either side and the particle
            itself: an odd number.
        inertia: w, what remains of a velocity.
        own_pull: c1, towards a particle's own best position.
        ring_pull: c2, towards the neighbourhood's.
        velocity_limit: v_max, in halves of the box's width; at 1 a particle can cross the box in
            two moves.
    """

    neighbourhood: int
    inertia: float
    own_pull: float
    ring_pull: float
    velocity_limit: float = 1.0


class Swarm(nn.Module):
    """L swarms of N particles in boxes of D dimensions.

    Args:
        rule: How particles move.
        positions: ``[L, N, D]`` at the beginning.
        low: ``[L, D]`` lower corner of the box.
        high: Upper corner.

    Attributes:
        positions: ``[L, N, D]``, to be evaluated next.
        velocities: ``[L, N, D]`` of the last move.
        best_positions: ``[L, N, D]`` with the largest fitness of each particle so far.
        best_fitness: ``[L, N]``; before the first evaluation minus infinity.
    """

    positions: Tensor
    velocities: Tensor
    best_positions: Tensor
    best_fitness: Tensor

    def __init__(self, rule: SwarmRule, positions: Tensor, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self._rule = rule
        self._low, self._high = low[:, None], high[:, None]
        self._limit = rule.velocity_limit * (self._high - self._low) / 2.0
        count, device = positions.shape[1], positions.device
        reach = rule.neighbourhood // 2
        steps = torch.arange(-reach, reach + 1, device=device)
        self._ring = (torch.arange(count, device=device)[:, None] + steps) % count
        self.register_buffer("positions", positions.clamp(self._low, self._high))
        self.register_buffer("velocities", torch.zeros_like(positions))
        self.register_buffer("best_positions", self.positions.clone())
        never = torch.full_like(positions[..., 0], -torch.inf)
        self.register_buffer("best_fitness", never)

    @property
    def best(self) -> Tensor:
        """The best position of each swarm so far, ``[L, D]``; the first particle's at first."""
        leader = self.best_fitness.argmax(dim=1)
        return self.best_positions[torch.arange(len(leader), device=leader.device), leader]

    @torch.no_grad()
    def remember(self, fitness: Tensor) -> Tensor:
        """Update the best positions by the ``fitness [L, N]`` of the present ones (2.53).

        Undefined and infinite fitness count as the worst, so they never are better.

        Returns:
            Whether a particle's present fitness is its best so far, ``[L, N]``.
        """
        better = fitness.isfinite() & (fitness > self.best_fitness)
        self.best_fitness.copy_(torch.where(better, fitness, self.best_fitness))
        kept = torch.where(better[..., None], self.positions, self.best_positions)
        self.best_positions.copy_(kept)
        return better

    @torch.no_grad()
    def move(self, own: Tensor, ring: Tensor) -> None:
        """Let all particles move; ``own`` and ``ring`` are r1 and r2, ``[L, N, D]``."""
        rule, velocities = self._rule, self.velocities
        leaders = self.best_fitness[:, self._ring].argmax(dim=2)  # [L, N] places on the ring
        leaders = self._ring.expand(len(leaders), -1, -1).gather(2, leaders[..., None])
        velocities.mul_(rule.inertia)
        way = self.best_positions - self.positions
        velocities.addcmul_(own, way, value=rule.own_pull)
        way = self.best_positions.gather(1, leaders.expand_as(velocities)).sub_(self.positions)
        velocities.addcmul_(ring, way, value=rule.ring_pull)
        velocities.clamp_(-self._limit, self._limit)
        self.positions.add_(velocities).clamp_(self._low, self._high)
