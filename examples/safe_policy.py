# SPDX-License-Identifier: Apache-2.0
"""4,096 arms under a random policy: with the bounds all keep their limits, without them none does.

As in training: states and actions are batches of PyTorch, on the CPU here. Each arm has the
limits of `config/panda.yaml`, and is exact: a constant acceleration is integrated for each step.
"""

from __future__ import annotations

import sys
import time

from viability_bounds_pkg import batch
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

try:
    import torch
except ModuleNotFoundError:
    sys.exit("safe_policy.py needs PyTorch: pip install torch")

ARMS, STEPS, DT = 4096, 300, 0.01  # s
TOLERANCE = 1e-9  # rad, rad/s
LIMITS = JointLimits(
    [f"panda_joint{j}" for j in range(1, 8)],
    q_min=[-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
    q_max=[2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
    v_max=[1.67, 1.67, 1.67, 1.67, 2.0, 2.0, 2.0],
    a_min=[-15.0, -3.0, -15.0, -15.0, -15.0, -15.0, -15.0],
    a_max=[15.0, 3.0, 15.0, 15.0, 15.0, 15.0, 15.0],
)
Q_MIN, Q_MAX, V_MAX, A_MIN, A_MAX = (
    torch.tensor(limit)
    for limit in (LIMITS.q_min, LIMITS.q_max, LIMITS.v_max, LIMITS.a_min, LIMITS.a_max)
)


def random_policy() -> torch.nn.Module:
    """Return a network from positions and speeds to accelerations as shares of their limits."""
    torch.manual_seed(0)
    n = len(LIMITS)
    layers = torch.nn.Linear(2 * n, 64), torch.nn.Tanh(), torch.nn.Linear(64, n), torch.nn.Tanh()
    return torch.nn.Sequential(*layers).double()


@torch.no_grad()
def roll_out(policy: torch.nn.Module, solver: BoundsSolver | None) -> tuple[int, float]:
    """Return how many arms always kept their limits, and how many states a second were computed.

    Args:
        policy: as `random_policy` returns it.
        solver: of the bounds, or None to keep to the acceleration limits alone.
    """
    torch.manual_seed(1)
    q = Q_MIN + torch.rand(ARMS, len(LIMITS), dtype=torch.float64) * (Q_MAX - Q_MIN)
    v = torch.zeros_like(q)
    kept = torch.ones_like(q, dtype=torch.bool)
    begin = time.perf_counter()
    for _ in range(STEPS):
        actions = policy(torch.cat([q, v], dim=1)) + 0.3 * torch.randn_like(q)
        lower, upper = A_MIN, A_MAX
        if solver is not None:
            lower, upper, _ = batch.bounds(solver, q, v)
        a = torch.clamp(actions * A_MAX, lower, upper)
        v_next = v + DT * a
        q_next = q + 0.5 * DT * (v + v_next)
        # Within the step the joint is farthest out where it turns back.
        farthest = torch.where(v * v_next < 0.0, q - 0.5 * v * v / a, q_next)
        kept &= (torch.minimum(farthest, q_next) >= Q_MIN - TOLERANCE) & (
            torch.maximum(farthest, q_next) <= Q_MAX + TOLERANCE
        )
        kept &= v_next.abs() <= V_MAX + TOLERANCE
        q, v = q_next, v_next
    return int(kept.all(dim=1).sum()), ARMS * STEPS / (time.perf_counter() - begin)


def main() -> int:
    """Print how many arms kept their limits; return 1 if one with the bounds did not."""
    policy = random_policy()
    safe, rate = roll_out(policy, BoundsSolver(LIMITS, DT))
    print(f"with the bounds {safe} of {ARMS} arms kept their limits, {rate:,.0f} states/s")
    unsafe, rate = roll_out(policy, None)
    print(f"without them {unsafe} of {ARMS}, {rate:,.0f} states/s")
    return 0 if safe == ARMS else 1


if __name__ == "__main__":
    sys.exit(main())
