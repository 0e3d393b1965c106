# SPDX-License-Identifier: Apache-2.0
"""Goals and pushes that are searched for to do worst, with and without the safety filter.

bash scripts/reproduce.sh adversary
bash scripts/reproduce.sh adversary --minutes 30          longer; 5 minutes of each row otherwise
bash scripts/reproduce.sh adversary --row Baxter         rows whose names contain it

A search plays episodes of 5 s: a posture to start from, five goals one after the other, when each
is given, and a push at the hand with each. The cross-entropy method brings one thing after the
other as near to its limit as it can: what the plan in hand leaves of the torque limits, positions,
speeds. The greedy adversary asks in each period for that corner of the acceleration bounds after
which least torque is left. Robot, bounds and controller are those of the files, with exact states.
"""

from __future__ import annotations

import argparse
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from direct import DirectLoop
from figure import Figure, table, verdict
from pieces import in_pieces

from torque_safety_controller.qp.terms import TaskTerm
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.goals import Goals
from viability_bounds_pkg.whole_arm.safety_filter import SafetyFilter

STIFF = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
EPISODE = 5.0  # s
GOALS = 5
POPULATION, ELITE = 15, 4
PATIENCE = 8
"""Generations without a worse episode after which the search begins anew."""
SPREAD = 0.05
"""Least standard deviation of the search, as a share of each range."""
SMALL, HARD = 0.01, 0.1
"""Shares of the torque limits that pushes take: within the reserve of plans, and beyond it."""
PUSHED = 3000
"""Random postures in which pushes are looked at."""
HOLDING = 0.9
"""Share of the torque limits that holding takes at most where an episode starts."""
SEARCHES = ("slack", "position", "speed")


class Row(NamedTuple):
    """What is tried.

    Attributes:
        robot: its file.
        share: of its torque limits.
        filtered: whether the safety filter is on.
        push: torque of pushes, as a share of the torque limits of any joint.
        greedy: whether the greedy adversary decides.
        free: whether the filter's constraints on the step are left out.
    """

    robot: str
    share: float = 1.0
    filtered: bool = True
    push: float = 0.0
    greedy: bool = False
    free: bool = False


ARMS = {
    "Baxter": ("baxter_left_arm", 1.0),
    "Panda at 60%": ("panda", 0.6),
    "TALOS at 60%": ("talos_left_arm", 0.6),
    "Panda": ("panda", 1.0),
    "TALOS": ("talos_left_arm", 1.0),
}
"""Robot and share of its torque limits."""


def kinds(robot: str, share: float) -> dict[str, Row]:
    """Return what is tried with an arm."""
    plain = {
        "goals": Row(robot, share),
        "greedy, no constraints": Row(robot, share, greedy=True, free=True),
    }
    if share == 1.0 and robot != "baxter_left_arm":
        return plain
    return plain | {
        "greedy": Row(robot, share, greedy=True),
        "goals and small pushes": Row(robot, share, push=SMALL),
        "goals and hard pushes": Row(robot, share, push=HARD),
        "goals, without": Row(robot, share, filtered=False),
    }


ROWS = {
    f"{arm}: {kind}": row for arm, which in ARMS.items() for kind, row in kinds(*which).items()
}


class CornerTask:
    """Asks for accelerations."""

    def __init__(self, a: np.ndarray) -> None:
        self._a = a

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return ``a`` as a term of the cost."""
        return TaskTerm(None, self._a, 1.0)


class CornerGoals(Goals):
    """Accelerations in place of goals.

    Attributes:
        a: asked for, shape (n,), rad/s^2.
    """

    def __init__(self, n: int) -> None:
        super().__init__(n)
        self.a = np.zeros(n)

    def tasks(self, gains: Any, stiffness: np.ndarray | None = None) -> list[Any]:
        """Return the task that asks for them."""
        return [CornerTask(self.a)]


class Unconstrained:
    """A safety filter that gives the QP no constraints: `choose` alone keeps the limits."""

    def __init__(self, keeper: SafetyFilter) -> None:
        self._keeper = keeper

    def __getattr__(self, name: str) -> Any:
        return getattr(self._keeper, name)

    def look(self, *arguments: Any) -> None:
        """Look; return nothing."""
        self._keeper.look(*arguments)


def pushed(loop: DirectLoop, share: float) -> np.ndarray:
    """Return what pushes at the hand accelerate joints by, shape (n,), rad/s^2, and a tenth more.

    Of pushes that take `share` of the torque limits, in random postures: what is to be declared.
    """
    rng, model, data = np.random.default_rng(0), loop.model, loop.model.createData()
    frame = model.getFrameId(loop.controller.robot.frame)
    most = np.zeros(len(loop.limits))
    for _ in range(PUSHED):
        q = rng.uniform(loop.limits.q_min, loop.limits.q_max)
        J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        torque = J[:3].T @ rng.standard_normal(3)
        torque *= (share * loop.config.torque_max / np.maximum(np.abs(torque), 1e-9)).min()
        M = pin.crba(model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        most = np.maximum(most, np.abs(np.linalg.solve(M, torque)))
    return 1.1 * most


class Arena:
    """An arm that episodes are played on.

    Args:
        row: what is tried.
    """

    def __init__(self, row: Row) -> None:
        self.row = row
        tau_max = DirectLoop(row.robot).config.torque_max
        changed = {"safety_filter": row.filtered, "torque_max": (row.share * tau_max).tolist()}
        self._changed = STIFF | changed
        self.loop = loop = DirectLoop(row.robot, self._changed)
        if row.filtered and row.push == SMALL:
            loop.robot.close()
            self._changed |= {"acceleration_disturbance": pushed(loop, SMALL).tolist()}
            self.loop = loop = DirectLoop(row.robot, self._changed)
        self.n = len(loop.limits)
        self.genes = self.n + GOALS * (self.n + 1 + (5 if row.push else 0))
        self._data = loop.model.createData()
        self._low, self._high = loop.limits.q_min, loop.limits.q_max
        if row.greedy:
            other = DirectLoop(row.robot, self._changed | {"safety_filter": True})
            self._scout = other.controller.safety_filter
            other.robot.close()

    def posture(self, genes: np.ndarray) -> np.ndarray:
        """Return the posture of genes in [0, 1]; their outer twelfths are the limits."""
        return self._low + (self._high - self._low) * np.clip(1.2 * genes - 0.1, 0.0, 1.0)

    def start(self, genes: np.ndarray) -> None:
        """Begin anew, at rest in a posture, or as near to it as it can be held."""
        self.loop.robot.close()
        # What is left of an episode before would change the next by a rounding, and then by more.
        self.loop = loop = DirectLoop(self.row.robot, self._changed)
        controller = loop.controller
        if self.row.greedy:
            controller.goals = CornerGoals(self.n)
        if self.row.free:
            controller.safety_filter = Unconstrained(controller.safety_filter)
        q, home = self.posture(genes), loop.config.start_positions
        for share in np.linspace(1.0, 0.0, 21):
            place = home + share * (q - home)
            torque = np.abs(pin.computeGeneralizedGravity(loop.model, self._data, place))
            if (torque <= HOLDING * loop.config.torque_max).all():
                break
        # The bounds keep a little off the position limits.
        loop.robot.reset(np.clip(place, self._low + 0.01, self._high - 0.01), np.zeros(self.n))
        loop.begin()

    def push(self, force: np.ndarray) -> None:
        """Push the hand, as far as its joints may be loaded by it."""
        loop = self.loop
        hand = loop.controller.robot
        torque = np.abs(hand.J[:3].T @ (hand.pose.rotation.T @ force))
        most = self.row.push * loop.config.torque_max / np.maximum(torque, 1e-9)
        force = force * min(1.0, float(most.min()))
        loop.robot.apply_wrench(hand.frame, force, np.zeros(3))

    def play(self, genes: np.ndarray) -> dict[str, float]:
        """Play an episode; return what was left of each limit at least, and other findings."""
        n = self.n
        self.start(genes[:n])
        loop = self.loop
        parts = genes[n:].reshape(GOALS, -1)
        shares = 0.1 + parts[:, n]
        begins = EPISODE * np.concatenate([[0.0], np.cumsum(shares) / shares.sum()])
        slack, wanted = np.inf, 0.0
        for part, begin, end in zip(parts, begins, begins[1:], strict=False):
            loop.controller.set_posture_goal(self.posture(part[:n]))
            force, window = np.zeros(3), (begin, end)
            if self.row.push:
                direction = 2.0 * part[n + 1 : n + 4] - 1.0
                force = 1e3 * direction / max(float(np.linalg.norm(direction)), 1e-9)
                first, last = np.sort(part[n + 4 : n + 6])
                window = begin + first * (end - begin), begin + last * (end - begin)
            while loop.t < end - 1e-9:
                if self.row.push:
                    if window[0] <= loop.t < window[1]:
                        self.push(force)
                    else:
                        loop.robot.clear_wrenches()
                left, torque = self.step()
                slack, wanted = min(slack, left), max(wanted, torque)
        return self.found(slack, wanted)

    def play_greedy(self, seed: int) -> dict[str, float]:
        """Play an episode of the greedy adversary from a random posture."""
        self.start(np.random.default_rng(seed).random(self.n))
        slack, wanted = np.inf, 0.0
        corner = np.ones(self.n)
        while self.loop.t < EPISODE - 1e-9:
            corner = self.worst_corner(corner)
            left, torque = self.step()
            slack, wanted = min(slack, left), max(wanted, torque)
        return self.found(slack, wanted)

    def worst_corner(self, corner: np.ndarray) -> np.ndarray:
        """Ask for the corner of the bounds after which least torque is left; return its signs.

        One joint after the other changes its side, beginning with the corner of before.
        """
        loop, dt = self.loop, self.loop.dt
        q, v, _ = loop.robot.state()
        lower, upper, _ = loop.bounds(q, v)
        zero, free = np.zeros(self.n), np.full(self.n, np.inf)

        def left(signs: np.ndarray) -> float:
            a = np.where(signs > 0.0, upper, lower)
            self._scout.reset()
            self._scout.look(q + dt * v + 0.5 * dt * dt * a, v + dt * a, zero, -free, free)
            return self._scout.slack

        corner, least = corner.copy(), left(corner)
        for j in range(self.n):
            corner[j] *= -1.0
            now = left(corner)
            if now < least:
                least = now
            else:
                corner[j] *= -1.0
        goals = loop.controller.goals
        assert isinstance(goals, CornerGoals)
        goals.a = np.where(corner > 0.0, upper, lower)
        return corner

    def step(self) -> tuple[float, float]:
        """Play a step; return the filter's slack, and the torque asked for as a share."""
        loop, controller = self.loop, self.loop.controller
        output = loop.step()
        torque = controller.robot.torque(output.a)
        if controller.additional is not None:
            torque = torque + controller.additional.last
        keeper = controller.safety_filter
        return (
            np.inf if keeper is None else keeper.slack,
            float((np.abs(torque) / controller.tau_max).max()),
        )

    def found(self, slack: float, wanted: float) -> dict[str, float]:
        """Return what an episode came to, limits as shares that were left of them."""
        monitor, config = self.loop.robot.monitor, self.loop.config
        room = np.minimum(monitor.closest_to_q_min, monitor.closest_to_q_max)
        keeper = self.loop.controller.safety_filter
        outcomes = Counter() if keeper is None else keeper.outcomes
        return {
            "slack": float(slack),
            "position": float((room / (self._high - self._low)).min()),
            "speed": float((1.0 - monitor.max_speed / config.velocity_max).min()),
            "torque": 1.0 - float(monitor.max_torque_ratio.max()),
            "asked": 1.0 - wanted,
            "changed": float(outcomes.total() - outcomes["as wanted"]),
            "outside": float(outcomes["outside"]),
        }


def search(arena: Arena, episodes: int, seed: int) -> dict[str, Any]:
    """Search for episodes that do worst; return the least that was found of each kind."""
    rng = np.random.default_rng(seed)
    least: dict[str, Any] = {}
    played = begun = 0
    while played < episodes:
        what = SEARCHES[begun % len(SEARCHES)]
        if what == "slack" and not arena.row.filtered:
            what = "asked"
        begun += 1
        mean, spread = np.full(arena.genes, 0.5), np.full(arena.genes, 0.5)
        best, since = np.inf, 0
        while played < episodes and since < PATIENCE:
            tried = np.clip(rng.normal(mean, spread, (POPULATION, arena.genes)), 0.0, 1.0)
            results = [arena.play(genes) for genes in tried]
            played += len(results)
            for genes, result in zip(tried, results, strict=True):
                note(least, result, genes.tolist())
            scores = np.array([result[what] for result in results])
            elite = tried[np.argsort(scores)[:ELITE]]
            mean = 0.3 * mean + 0.7 * elite.mean(axis=0)
            spread = np.maximum(0.3 * spread + 0.7 * elite.std(axis=0), SPREAD)
            since = since + 1 if scores.min() > best - 1e-6 else 0
            best = min(best, float(scores.min()))
    return least | {"episodes": played}


def note(least: dict[str, Any], result: dict[str, float], genes: Any) -> None:
    """Keep the least of each kind, and what led to it."""
    for kind, value in result.items():
        worse = max if kind in ("changed", "outside") else min
        if kind not in least or worse(value, least[kind]) != least[kind]:
            least[kind] = value
            least[f"{kind}, by"] = genes


def work(name: str, seed: int, episodes: int) -> dict[str, Any]:
    """Play the episodes of a piece of a row."""
    arena = Arena(ROWS[name])
    if not arena.row.greedy:
        return search(arena, episodes, seed)
    least: dict[str, Any] = {}
    for k in range(episodes):
        note(least, arena.play_greedy(1000 * seed + k), 1000 * seed + k)
    return least | {"episodes": episodes}


def main() -> int:
    """Search, print the table; return whether the filter kept all limits where it is to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0, help="played for each row")
    parser.add_argument("--row", default="", help="rows whose names contain this alone")
    given = parser.parse_args()
    episodes = max(round(60.0 * given.minutes / EPISODE), 1)
    pieces = [(name, 1, episodes) for name in ROWS if given.row in name]
    figure, kept = Figure("adversary"), True
    for (name, *_), least in in_pieces("adversary", work, pieces):
        row = ROWS[name]
        left = [least[kind] for kind in ("position", "speed", "torque")]
        fine = left[0] >= 0.0 and left[1] >= 0.0 and left[2] >= -1e-9
        promised = row.filtered and row.push <= SMALL
        kept &= fine or not promised
        said = verdict(fine, "kept") if promised else "kept" if fine else "passed"
        figure.rows.append(
            (
                name,
                f"{least['episodes']}",
                *(f"{100.0 * each:.2g}%" for each in left),
                f"{100.0 * least['slack']:.2g}%" if row.filtered else "-",
                f"{least['outside']:.0f}" if row.filtered else "-",
                said,
            )
        )
        figure.metrics |= {f"{name}: {key}": x for key, x in least.items() if " by" not in key}
        print(*figure.rows[-1], sep=" | ", flush=True)
    figure.save(None)
    heads = ("adversary", "episodes", "position left", "speed left", "torque left", "plan leaves")
    print("\n" + table([figure], (*heads, "steps without plan", "")))
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
