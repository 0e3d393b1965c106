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
ACTIVE = {"leak_rate": 100.0, "gain": 300.0}
"""Of the friction compensation: 70% of the friction, the way the joint moves."""


class TimedForce(NamedTuple):
    """A force on a link for some time."""

    name: str
    link: str
    force: np.ndarray
    """Shape (3,), N, in the root link's axes."""
    begin: float
    """s."""
    end: float
    """s."""


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
    friction: Mapping[str, float] | None = None,
) -> Pushed:
    """Push an arm that holds its hand where it is; arguments as of `course`."""
    loop = DirectLoop(ROBOT, changed)
    loop.change_friction(**friction or {})
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
        steady = [place[run.during(each)][-last:].mean() for each in on_hand]
        largest = [place[run.during(each)].max() for each in on_hand]
        force = np.linalg.norm(on_hand[0].force)
        result |= {
            "steady_m": float(np.mean(steady)),
            "largest_m": float(np.mean(largest)),
            "stiffness_n_m": float(force / np.mean(steady)),
        }
        result |= {
            f"steady_{each.name}_m": float(value)
            for each, value in zip(on_hand, steady, strict=True)
        }
    return result


@cache
def runs() -> dict[str, Pushed]:
    """Return the course of figure 6 without and with null-space compliance."""
    return {name: push(changed) for name, changed in MODES.items()}


def figure_6() -> Figure:
    """The hand is stiff either way; what the elbow does when pushed."""
    figure = Figure("paper1-fig6")
    found = {name: judge(run) for name, run in runs().items()}
    for name, run in runs().items():
        figure.metrics |= {f"{name}: {key}": value for key, value in found[name].items()}
        figure.data |= {
            f"{name}: {what}": value
            for what, value in (("t", run.t), ("q", column(run.samples, "q")))
        }
        figure.data[f"{name}: error"] = column(run.samples, "error")
    lacking, with_it = found.values()
    ratio = with_it["witness_motion_rad"] / lacking["witness_motion_rad"]
    stiffer = with_it["stiffness_n_m"] / lacking["stiffness_n_m"]
    first = next(iter(runs().values()))
    _, least = weakest_direction(DirectLoop(ROBOT), ELBOW)
    figure.metrics |= {"ratio": ratio, "stiffness_ratio": stiffer, "stiction_elbow_n": least}
    joint = first.loop.config.joints[int(with_it["witness_joint"])]
    limits = all(within_limits(run.loop) for run in runs().values())
    told = [
        f"{1e3 * each['elbow_hand_m']:.1f} mm and {np.degrees(each['elbow_hand_rad']):.2f}°"
        for each in found.values()
    ]
    held = all(
        each["hand_m"] <= 5e-3 and each["hand_rad"] <= np.radians(1) for each in found.values()
    )
    figure.rows += [
        (
            f"Fig. 6, 7, 8: elbow pushed with {ELBOW_FORCE:.0f} N for 3 s, in both directions "
            f"(stiction alone holds {least:.0f} N)",
            "hardly moves without; much easier to move with",
            f"null-space joint moves {lacking['witness_motion_rad']:.3f} rad without, "
            f"{with_it['witness_motion_rad']:.3f} rad with ({joint}), {ratio:.0f} times further; "
            f"hand meanwhile within {told[0]} without, {told[1]} with",
            "so with the file's values" if ratio >= 3.0 and held and limits else "DIFFERS",
        ),
        (
            f"Fig. 6: hand pushed with {HAND_FORCE:.0f} N along x, y, z, in both directions",
            "stiff without, also stiff with",
            f"{1e3 * lacking['steady_m']:.2f} mm without, {1e3 * with_it['steady_m']:.2f} mm "
            f"with, mean of the last 0.3 s of all six pushes; on the way "
            f"{1e3 * lacking['largest_m']:.2f} and {1e3 * with_it['largest_m']:.2f} mm",
            "stiffness not lower" if stiffer >= 1.0 else "DIFFERS",
        ),
    ]
    figure.save(_picture(int(with_it["witness_joint"])))
    return figure


def _picture(witness: int) -> plt.Figure:
    picture, axes = plt.subplots(2, 1, figsize=(12, 8), sharex=True, layout="constrained")
    top = 1.25 * max(np.abs(run.angles[:, witness]).max() for run in runs().values())
    for axis, (name, run) in zip(axes, runs().items(), strict=True):
        turned = run.loop.controller.goals.pose_des.rotation
        error = 1e3 * column(run.samples, "error")[:, :3] @ turned.T
        for k, color in enumerate(("tab:red", "tab:green", "tab:blue")):
            axis.plot(run.t, error[:, k], color=color, lw=1, label=f"hand, {'xyz'[k]}")
        for each in run.pushes:
            elbow = each.link == ELBOW
            axis.axvspan(each.begin, each.end, color="orange" if elbow else "gray", alpha=0.15)
            text = f"{each.name}\n{np.linalg.norm(each.force):.0f} N"
            where = 0.5 * (each.begin + each.end)
            axis.text(where, 4.9, text, ha="center", va="top", fontsize="small")
        axis.set(ylabel="error of the hand [mm]", ylim=(-5.0, 5.0), title=name)
        axis.grid(alpha=0.3)
        right = axis.twinx()
        joint = run.loop.config.joints[witness]
        right.plot(run.t, run.angles[:, witness], color="black", lw=2, label=f"{joint} (right)")
        right.set(ylabel="angle of the witness joint [rad]", ylim=(-top, top))
        lines = [*axis.get_lines(), *right.get_lines()]
        axis.legend(lines, [line.get_label() for line in lines], loc="lower left", ncols=4)
    axes[-1].set_xlabel("time [s]; gray: hand pushed, orange: elbow pushed")
    return picture


def forces() -> Figure:
    """How far the elbow gives way to which force; friction compensated, too."""
    figure = Figure("paper1-elbow-force")
    compliant = MODES["with null-space compliance"]
    cases = {name: (changed, {}) for name, changed in MODES.items()}
    active = "with, and friction compensated by 70%"
    cases[active] = compliant | {"friction_compensation": 0.7}, ACTIVE
    sizes = (20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0)
    picture, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    for name, (changed, friction) in cases.items():
        found = [
            judge(push(changed, hand=0.0, elbow=size, held=1.0, friction=friction))
            for size in sizes
        ]
        moved, off_goal = (
            np.array([each[key] for each in found])
            for key in ("witness_motion_rad", "elbow_hand_m")
        )
        turned = np.array([each["elbow_hand_rad"] for each in found])
        figure.data[name] = np.column_stack([sizes, moved, off_goal, turned])
        axes[0].plot(sizes, moved, "o-", label=name)
        axes[1].plot(sizes, 1e3 * off_goal, "o-", label=name)
        yielding = [size for size, angle in zip(sizes, moved, strict=True) if angle > 0.1]
        least = f"{yielding[0]:.0f} N" if yielding else "more"
        figure.metrics[f"{name}: least_force_n"] = yielding[0] if yielding else float("nan")
        figure.metrics[f"{name}: hand_m"] = float(off_goal.max())
        figure.metrics[f"{name}: hand_rad"] = float(turned.max())
        held = off_goal.max() <= 5e-3
        figure.rows.append(
            (
                f"Elbow pushed with 20 to 140 N for 2 s, {name}",
                "outlook: compensate friction, for active compliance"
                if "friction" in name
                else "-",
                f"{least} to move it by 0.1 rad; hand within {1e3 * off_goal.max():.1f} mm and "
                f"{np.degrees(turned.max()):.2f}°",
                "for comparison" if held else "DIFFERS",
            )
        )
    axes[0].set(xlabel="force on the elbow [N]", ylabel="null-space joint moves [rad]")
    axes[1].set(xlabel="force on the elbow [N]", ylabel="hand off its goal, at most [mm]")
    axes[1].axhline(5.0, color="black", linestyle=":", label="5 mm")
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small")
    figure.save(picture)
    return figure
