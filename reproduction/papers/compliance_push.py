# SPDX-License-Identifier: Apache-2.0
"""Figures 6 to 8 of [Benallegue2021]: pushed at the hand and at the elbow, and released."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from direct import DirectLoop, Sample, column, hand_errors, within_limits
from figure import Figure

from torque_safety_controller.parts.friction import Friction

ROBOT = "talos_left_arm"
HAND = "wrist_left_ft_tool_link"
ELBOW = "arm_left_4_link"  # its origin is the elbow
MODES = {
    "without null-space compliance": {"integral_action": "joints"},
    "with null-space compliance": {"integral_action": "task"},
}
RAMP = 0.3  # s, in which a person's push grows
HAND_FORCE, ELBOW_FORCE = 50.0, 100.0  # N
PART, WITH_FILE = "paper1-compliance", "so with the file's values"
HEADS = ("figure", "the paper", "without", "with", "")


class TimedForce(NamedTuple):
    """A force on a link from begin to end, s: shape (3,), N, in the root link's axes."""

    name: str
    link: str
    force: np.ndarray
    begin: float
    end: float


class Pushed(NamedTuple):
    """What pushes did to an arm."""

    samples: tuple[Sample, ...]
    pushes: tuple[TimedForce, ...]
    loop: DirectLoop

    @property
    def t(self) -> np.ndarray:
        """Time from the start, shape (N,), s."""
        return column(self.samples, "t") - self.samples[0].t

    @property
    def angles(self) -> np.ndarray:
        """How far the joints are from where they began, shape (N, n), rad."""
        q = column(self.samples, "q")
        return q - q[0]

    def during(self, push: TimedForce, rest: float = 0.0) -> slice:
        """Return the steps of a push and some seconds more."""
        first = round(push.begin / self.loop.dt)
        return slice(first, round((push.end + rest) / self.loop.dt))

    def named(self, *names: str) -> list[TimedForce]:
        """Return the pushes whose names begin with one of `names`."""
        return [push for push in self.pushes if push.name.startswith(names)]


def weakest_direction(loop: DirectLoop, link: str) -> tuple[np.ndarray, float]:
    """Return in which direction a link gives way to the least force, shape (3,), and that, N.

    A force f moves the null-space direction n at all if f'J n exceeds what stiction takes,
    sum of F_s |n_i|. The largest ratio is searched at random.
    """
    q = loop.robot.state().q
    data = loop.model.createData()
    pin.computeJointJacobians(loop.model, data, q)
    pin.updateFramePlacements(loop.model, data)
    J, J_link = (
        pin.getFrameJacobian(
            loop.model, data, loop.model.getFrameId(name), pin.LOCAL_WORLD_ALIGNED
        )
        for name in (HAND, link)
    )
    null = np.linalg.svd(J)[2][6:].T
    directions = null @ np.random.default_rng(0).normal(size=(null.shape[1], 100_000))
    # The compensation's model is the friction as identified.
    stiction = loop.controller.find(Friction).settings.model.static
    motion = J_link[:3] @ directions / (np.abs(directions).T @ stiction)
    sizes = np.linalg.norm(motion, axis=0)
    best = sizes.argmax()
    return motion[:, best] / sizes[best], 1.0 / float(sizes[best])


def course(
    loop: DirectLoop, hand: float, elbow: float, axes: str = "xyz", held: float = 1.5
) -> tuple[TimedForce, ...]:
    """Return pushes on the hand, there and back along each axis, and then on the elbow.

    Args:
        loop: the arm.
        hand: force on the hand, N; 0 for none.
        elbow: force on the elbow in the direction that needs least, N.
        axes: of the forces on the hand.
        held: how long each lasts, s; on the elbow twice as long.
    """
    pause, t = 0.5, 0.5
    pushes = []
    for axis in axes if hand else "":
        for sign, name in ((1.0, "+"), (-1.0, "-")):
            force = sign * hand * np.eye(3)["xyz".index(axis)]
            pushes.append(TimedForce(f"{name}{axis}", HAND, force, t, t + held))
            t += held + pause
    direction, _ = weakest_direction(loop, ELBOW)
    for sign, name in ((1.0, "elbow"), (-1.0, "elbow, back")):
        pushes.append(TimedForce(name, ELBOW, sign * elbow * direction, t, t + 2.0 * held))
        t += 2.0 * held + pause
    return tuple(pushes)


def push(
    changed: Mapping[str, Any],
    hand: float = HAND_FORCE,
    elbow: float = ELBOW_FORCE,
    axes: str = "xyz",
    held: float = 1.5,
) -> Pushed:
    """Push an arm that holds its hand where it is; arguments as of `course`."""
    loop = DirectLoop(ROBOT, changed)
    loop.run(0.5)
    pushes = course(loop, hand, elbow, axes, held)
    begin = loop.t

    def each(t: float) -> None:
        loop.robot.clear_wrenches()
        for each_push in pushes:
            if each_push.begin <= t - begin < each_push.end:
                share = min(1.0, (t - begin - each_push.begin) / RAMP)
                loop.robot.apply_wrench(each_push.link, share * each_push.force, np.zeros(3))

    return Pushed(loop.run(pushes[-1].end + 1.0, each), pushes, loop)


def judge(run: Pushed) -> dict[str, float]:
    """Return what a run amounts to: motion of the null space, and what the hand did."""
    place, turn = hand_errors(run.samples)
    pushes = run.named("elbow")
    elbow = slice(run.during(pushes[0]).start, len(run.samples))
    moved = np.abs(run.angles[elbow] - run.angles[elbow][0]).max(axis=0)
    result = {
        "witness_joint": float(moved.argmax()),
        "witness_motion_rad": float(moved.max()),
        "elbow_hand_m": float(place[elbow].max()),
        "elbow_hand_rad": float(turn[elbow].max()),
        "hand_m": float(place.max()),
        "hand_rad": float(turn.max()),
    }
    on_hand = run.named("+", "-")
    if on_hand:
        last = round(0.3 / run.loop.dt)
        result |= {
            "steady_m": float(np.mean([place[run.during(p)][-last:].mean() for p in on_hand])),
            "largest_m": float(np.mean([place[run.during(p)].max() for p in on_hand])),
        }
    return result


@cache
def runs() -> dict[str, Pushed]:
    """Return the course of figure 6 without and with null-space compliance."""
    return {name: push(changed) for name, changed in MODES.items()}


def figure_6() -> Figure:
    """The hand is stiff either way; what the elbow does when pushed."""
    figure = Figure("paper1-fig6", PART, HEADS)
    found = {name: judge(run) for name, run in runs().items()}
    for name, run in runs().items():
        figure.metrics |= {f"{name}: {key}": value for key, value in found[name].items()}
        figure.data |= {
            f"{name}: {what}": column(run.samples, what) for what in ("t", "q", "error")
        }
    lacking, with_it = found.values()
    _, least = weakest_direction(DirectLoop(ROBOT), ELBOW)
    figure.metrics["stiction_elbow_n"] = least
    held = all(
        each["hand_m"] <= 5e-3 and each["hand_rad"] <= np.radians(1) for each in found.values()
    )
    figure.add(
        f"Fig. 6, 7, 8: elbow pushed with {ELBOW_FORCE:.0f} N for 3 s, in both directions "
        f"(stiction alone holds {least:.0f} N)",
        "hardly moves without; much easier to move with",
        *(
            f"null-space joint {each['witness_motion_rad']:.3f} rad; hand "
            f"{1e3 * each['elbow_hand_m']:.1f} mm, {np.degrees(each['elbow_hand_rad']):.2f}°"
            for each in found.values()
        ),
        holds=held
        and with_it["witness_motion_rad"] >= 3.0 * lacking["witness_motion_rad"]
        and all(within_limits(run.loop) for run in runs().values()),
        so=WITH_FILE,
    )
    figure.add(
        f"Fig. 6: hand pushed with {HAND_FORCE:.0f} N along x, y, z, in both directions",
        "stiff without, also stiff with",
        *(
            f"{1e3 * each['steady_m']:.2f} mm; on the way {1e3 * each['largest_m']:.2f} mm"
            for each in found.values()
        ),
        holds=with_it["steady_m"] <= lacking["steady_m"],
        so="stiffness not lower",
    )
    figure.save(_picture(int(with_it["witness_joint"])), "nullspace")
    return figure


def _picture(witness: int) -> plt.Figure:
    """Draw the joint that moves most, and the hand, while the elbow is pushed to and fro."""
    picture, axes = plt.subplots(1, 2, figsize=(10, 3.7), layout="constrained")
    for (name, run), color in zip(runs().items(), ("tab:red", "tab:green"), strict=True):
        pushes = run.named("elbow")
        begin = run.during(pushes[0]).start - round(0.5 / run.loop.dt)
        t, angle = run.t[begin:], run.angles[begin:, witness]
        axes[0].plot(t, angle - angle[0], color=color, label=name)
        axes[1].plot(t, 1e3 * hand_errors(run.samples)[0][begin:], color=color, label=name)
    for axis in axes:
        for each in pushes:
            axis.axvspan(each.begin, each.end, color="tab:orange", alpha=0.12, lw=0)
        axis.set(xlabel=f"time, s; shaded: elbow pushed with {ELBOW_FORCE:.0f} N")
        axis.grid(alpha=0.3)
    axes[0].set(ylabel=f"{run.loop.config.joints[witness]} moves by, rad")
    axes[1].set(ylabel="hand off its goal, mm", ylim=(0.0, 3.0))
    axes[1].legend(fontsize=9)
    return picture
