# SPDX-License-Identifier: Apache-2.0
"""Limits of three imperfect robots, late, coarse and noisy, with and without remedies.

bash scripts/reproduce.sh imperfect                 the tables of docs/results.md
bash scripts/reproduce.sh imperfect panda           those of one robot
bash scripts/reproduce.sh imperfect --minutes 1     quicker: 1 minute each in place of 10

The real nodes in one process, in lockstep, with `config/imperfect/<robot>.yaml`. Each minute has
its own seed: goals anew each second, half of the joints at their limits, pushes, and rests in
which joints lie on their limits. Every second minute has a posture task so stiff that the limits
decide. Limits are checked at each physics step, against the true state. Rows that are not played
stay on the page.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import cache
from multiprocessing import get_context
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from chain import load_node_values, run_chain
from figure import DIFFERS, Figure, Row, page_rows, table, write_part

from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.ros_harness import private_domain

PART = "imperfect"
ROBOTS = ("panda", "talos_left_arm", "baxter_left_arm")
MINUTE = 60.0  # s
FAST = 9  # goals of a second each
REST = 6.0  # s of a goal that is kept
SETTLED = 5.0  # s after which the torque steps of such a goal count
ON_ITS_WAY = 0.02  # rad that a joint moves afterwards; then they do not
RISE = 0.2  # s
UNUSED = ("acceleration_limits", "ft_wrench")
HANDS = ("ideal", "all")
"""Cases whose hand is looked at four times, not once."""
STIFF = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
"""A posture task that drives each joint to its limits, whatever the hand does."""

OF_ROBOT = ("rotor_inertia", "acceleration_min", "acceleration_max")
"""What the files of imperfect robots have of robot and model: the same in all cases."""

STEP_AT_REST, HAND_FACTOR, TORQUE_ROUNDING = 0.05, 3.0, 1e-9
"""What is promised: step of torque, of its limit; hand, of the ideal one's distance; share."""
HEADS = (
    "case",
    "minutes",
    "position, rad",
    "speed, rad/s",
    "torque, of tau_max",
    "step at rest, of tau_max",
    "hand at rest, mm",
    "",
)

PUSHED = {
    "panda": {"panda_hand": 10.0, "panda_link4": 20.0},
    "talos_left_arm": {"wrist_left_ft_tool_link": 20.0, "arm_left_4_link": 40.0},
    "baxter_left_arm": {"left_gripper": 5.0, "left_lower_elbow": 10.0},
}
"""Links that are pushed, and how hard, N."""

Values = dict[str, dict[str, Any]]
"""Parameters by node."""

_held = ExitStack()


class Case(NamedTuple):
    """What is spoilt, and what is done about it.

    Attributes:
        title: of the row.
        spoilt: how many times the imperfections of the file are simulated: 0, 1 or 2.
        done: whether all that the file of the imperfect robot does about them is done,
        changed: but for these parameters, by node.
        outages: whether all commands fail for up to 0.2 s, some 1.5 times a second.
        filtered: whether the safety filter is on, also where the file does without it.
        torque: share of the torque limits that the motors have.
    """

    title: str
    spoilt: int
    done: bool = True
    changed: Mapping[str, Mapping[str, Any]] = {}
    outages: bool = False
    filtered: bool = False
    torque: float = 1.0


NOTHING_DECLARED: dict[str, Any] = {
    "position_error": [],
    "velocity_error": [],
    "delay": 0,
    "delay_jitter": 0,
    "missed_deadlines": 0,
    "motor_bandwidth": [],
    "bounds_dt_factor": 2.0,
}
NO_PREDICTION = {"estimator_node": {"delay": 0, "motor_bandwidth": []}}
NO_OBSERVER = {"estimator_node": {"velocity_estimation": False}}
BRAKES = {"bullet_node": {"acceleration_min": [], "acceleration_max": []}}
CASES = {
    "ideal": Case("ideal", 0, done=False),
    "nothing": Case("nothing done", 1, done=False),
    "no_margins": Case(
        "all but margins and horizon", 1, changed={"bounds_node": NOTHING_DECLARED}
    ),
    "no_prediction": Case("all but prediction", 1, changed=NO_PREDICTION),
    "no_observer": Case("all but the observer", 1, changed=NO_OBSERVER),
    "all": Case("all done", 1),
    "twice": Case("twice as much as declared", 2),
    "outage_brake": Case("commands fail for 0.2 s, brakes", 1, changed=BRAKES, outages=True),
    "outage_stop": Case("commands fail for 0.2 s, stop", 1, outages=True),
    "filter": Case("safety filter", 1, filtered=True),
    "filter_weak": Case("safety filter, 60% of its torque", 1, filtered=True, torque=0.6),
}
AT_LENGTH = ("all", "filter", "filter_weak")
"""Cases that are played for longer."""
WITHIN_DECLARED = (*AT_LENGTH, "outage_stop")
"""Cases in which no limit may be passed: what is spoilt is within what is declared."""
NOT_PLAYED = {("baxter_left_arm", "filter"), ("baxter_left_arm", "filter_weak")}
"""Baxter has the filter in each case, and cannot hold itself with less torque."""
DOUBLED = ("encoder_resolution", "position_noise", "velocity_noise", "torque_constant_error")
DOUBLED += ("torque_ripple", "current_noise", "state_delay", "command_delay", "missed_in_row")
HALVED = ("motor_bandwidth", "velocity_filter_hz")
KNOWING = ("bounds_node", "controller_node", "estimator_node")
"""Nodes that are told what is spoilt."""


def scaled(imperfections: Mapping[str, Any], factor: int) -> dict[str, Any]:
    """Return imperfections that are `factor` times as bad."""

    def times(value: Any, by: float) -> Any:
        return [by * item for item in value] if isinstance(value, list) else by * value

    result = dict(imperfections)
    for names, by in ((DOUBLED, factor), (HALVED, 1.0 / factor)):
        result |= {name: times(result[name], by) for name in names if name in result}
    return result


def node_values(robot: str, case: Case, seed: int) -> Values:
    """Return the parameters of all nodes that take part."""
    plain, imperfect = load_node_values(robot), load_node_values(robot, f"imperfect/{robot}")
    values: Values = {}
    for node, own in plain.items():
        chosen = imperfect[node] if case.done and node in KNOWING else own
        if node == "bullet_node" and case.spoilt:
            chosen = own | scaled(
                {k: v for k, v in imperfect[node].items() if own.get(k) != v}, case.spoilt
            )
            if case.outages:
                rate = chosen["rate_hz"]
                chosen |= {"outage_probability": 1.5 / rate, "outage_longest": round(0.2 * rate)}
        of_robot = {name: imperfect[node][name] for name in OF_ROBOT if name in imperfect[node]}
        changed = dict(case.changed.get(node, {}))
        values[node] = chosen | of_robot | changed
        if case.filtered and node == "controller_node":
            values[node] |= {"safety_filter": True}
        if values[node].get("torque_max"):
            values[node]["torque_max"] = [case.torque * tau for tau in values[node]["torque_max"]]
    values["bullet_node"] |= {"imperfection_seed": seed}
    if not values["controller_node"].get("use_estimated_states"):
        del values["estimator_node"]
    return values


class Course:
    """A minute of goals and pushes, the same for each case.

    Args:
        values: of the controller node.
        robot: name of its file.
        seed: of the random numbers.

    Attributes:
        scenario: as in a scenario file.
        rests: from when to when torque steps count as those at rest, s.
    """

    def __init__(self, values: Mapping[str, Any], robot: str, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._joints = list(values["joints"])
        self._low, self._high = (np.array(values[f"position_{end}"]) for end in ("min", "max"))
        locked = dict(
            zip(values.get("locked_joints", []), values.get("locked_positions", []), strict=True)
        )
        self._model = build_model(read_urdf(values["robot_description"]), self._joints, locked)
        self._data = self._model.createData()
        self._frames = values["base_frame"], values["end_effector_frame"]
        self.rests: list[tuple[float, float]] = []
        events: list[dict[str, Any]] = []
        for time in np.arange(0.0, MINUTE, FAST + REST).tolist():
            for second in (time + k for k in range(FAST)):
                events += self._goal(second, self._at_limits())
                if time % (2.0 * (FAST + REST)):
                    events += self._push(second + 0.5 * float(self._rng.random()), PUSHED[robot])
            events += self._goal(time + FAST, self._at_limits())
            self.rests.append((time + FAST + SETTLED, time + FAST + REST))
        self.scenario = {"duration": MINUTE, "events": events}

    def pose(self, q: np.ndarray) -> pin.SE3:
        """Return the pose of the hand in the base frame."""
        pin.framesForwardKinematics(self._model, self._data, q)
        base, hand = (self._data.oMf[self._model.getFrameId(name)] for name in self._frames)
        return base.actInv(hand)

    def _at_limits(self) -> np.ndarray:
        """Return a posture with half of the joints at their limits."""
        low, high, rng = self._low, self._high, self._rng
        n = low.size
        ends = np.where(rng.random(n) < 0.5, low, high)
        return np.where(rng.random(n) < 0.5, ends, rng.uniform(low, high))

    def _goal(self, time: float, q: np.ndarray) -> Iterator[dict[str, Any]]:
        yield {"time": time, "posture": dict(zip(self._joints, q.tolist(), strict=True))}
        yield from self.pose_goal(time, self.pose(q))

    def pose_goal(self, time: float, pose: pin.SE3) -> Iterator[dict[str, Any]]:
        """Yield the event of a pose goal."""
        position, orientation = pose.translation, pin.Quaternion(pose.rotation).coeffs()
        yield {
            "time": time,
            "pose": {"position": position.tolist(), "orientation": orientation.tolist()},
        }

    def _push(self, time: float, links: Mapping[str, float]) -> Iterator[dict[str, Any]]:
        """Yield a push that rises within `RISE`, as a person's does, and lasts as long again."""
        direction = self._rng.standard_normal(3)
        link = list(links)[self._rng.integers(len(links))]
        force = links[link] * direction / np.linalg.norm(direction)
        for share in np.linspace(0.0, 1.0, 21)[1:].tolist():
            duration = RISE if share == 1.0 else RISE / 20
            push = {"link": link, "force": (share * force).tolist(), "duration": duration}
            yield {"time": time + (share - 0.05) * RISE, "push": push}


class Minute(NamedTuple):
    """What a minute showed; the largest of all joints.

    Attributes:
        position, speed: how far beyond the limits, rad and rad/s.
        torque: share of torque_max.
        step_at_rest: largest change of torque in a period at rest, share of torque_max.
    """

    position: float
    speed: float
    torque: float
    step_at_rest: float


def play(robot: str, name: str, seed: int) -> Minute:
    """Play a minute of a case."""
    values = node_values(robot, CASES[name], seed)
    course = Course(values["controller_node"], robot, seed)
    if seed % 2:
        values["controller_node"] |= STIFF
    result = run_chain({}, course.scenario, values, UNUSED)
    run = result.run
    steps = np.abs(np.diff(run.tau, axis=0)) / values["controller_node"]["torque_max"]
    at_rest = np.zeros(len(steps), dtype=bool)
    for begin, end in course.rests:
        during = (run.t[1:] >= begin) & (run.t[1:] < end)
        if np.ptp(run.q[1:][during], axis=0).max() < ON_ITS_WAY:
            at_rest |= during
    keys = ("position_violation_rad", "velocity_violation_rad_s", "torque_ratio")
    position, speed, torque = (float(result.vector(key).max()) for key in keys)
    return Minute(position, speed, torque, float(np.nanmax(steps[at_rest], initial=0.0)))


def hand_at_rest(robot: str, name: str, seed: int) -> float:
    """Return how far the hand is from a goal 8 s after it was sent, m."""
    values = node_values(robot, CASES[name], seed)
    course = Course(values["controller_node"], robot, seed)
    start = np.array(values["bullet_node"]["start_positions"])
    goal = course.pose(start + np.random.default_rng(seed).uniform(-0.2, 0.2, start.size))
    scenario = {"duration": 8.0, "events": list(course.pose_goal(0.0, goal))}
    result = run_chain({}, scenario, values, UNUSED)
    return float(np.linalg.norm(course.pose(result.q).translation - goal.translation))


@cache
def encoder_step_at_hand(robot: str) -> float:
    """Return how far a step of all encoders may move the hand at the start, m."""
    values = node_values(robot, CASES["all"], 0)
    steps = values["bullet_node"].get("encoder_resolution") or [0.0]
    start = np.array(values["bullet_node"]["start_positions"])
    course = Course(values["controller_node"], robot, 0)
    moved = [course.pose(start + dq) for dq in np.diag(np.broadcast_to(steps, start.shape))]
    here = course.pose(start).translation
    return float(sum(np.linalg.norm(pose.translation - here) for pose in moved))


def verdict(name: str, worst: Minute, hand: float, allowed: float) -> str:
    """Return the last entry of a row, empty where nothing is promised.

    Args:
        name: of the case.
        worst: of its minutes.
        hand: median distance of the hand from its goals, m.
        allowed: what it may be, m.
    """
    if name not in WITHIN_DECLARED:
        return ""
    passed = max(worst.position, worst.speed, worst.torque - 1.0 - TORQUE_ROUNDING) > 0.0
    wrong = ["a limit was passed"] * passed
    if name == "all":
        wrong += ["step at rest"] * (worst.step_at_rest > STEP_AT_REST)
        wrong += ["hand at rest"] * (hand > allowed)
    return f"{DIFFERS}: {', '.join(wrong)}" if wrong else "kept"


def row(name: str, minutes: Sequence[Minute], hands: Sequence[float], allowed: float) -> Row:
    """Return a row of the table: the worst of the minutes, the hand, and the `verdict`."""
    worst, median = Minute(*np.max(minutes, axis=0).tolist()), float(np.median(hands))
    return (
        CASES[name].title,
        str(len(minutes)),
        f"{worst.position:.2g}",
        f"{worst.speed:.2g}",
        f"{worst.torque:.3f}",
        f"{worst.step_at_rest:.3f}",
        f"{1e3 * median:.2f} to {1e3 * max(hands):.2f}",
        verdict(name, worst, median, allowed),
    )


def _own_domain() -> None:
    """Let the nodes of this process see no others, until it ends."""
    os.environ["ROS_DOMAIN_ID"] = str(_held.enter_context(private_domain()))


def play_all(robots: Sequence[str], names: Sequence[str], at_length: int, others: int) -> Figure:
    """Play cases of robots for some minutes; put their rows on the page, and print them."""
    figure = Figure("imperfect")
    rows = page_rows(PART)
    with ProcessPoolExecutor(
        os.cpu_count(), get_context("spawn"), initializer=_own_domain
    ) as pool:
        runs = {}
        for robot in robots:
            for name in names:
                if (robot, name) in NOT_PLAYED:
                    continue
                # One minute alone is one with a stiff posture task.
                seeds = range(at_length) if name in AT_LENGTH else range(1, others + 1)
                runs[robot, name] = (
                    [pool.submit(play, robot, name, seed) for seed in seeds],
                    [
                        pool.submit(hand_at_rest, robot, name, k)
                        for k in range(4 if name in HANDS else 1)
                    ],
                )
        for (robot, name), futures in runs.items():
            minutes, hands = ([each.result() for each in some] for some in futures)
            ideal = rows.get((robot, CASES["ideal"].title))
            # The median that the page has of the ideal robot, in mm.
            hand = 1e-3 * float(ideal[-2].split()[0]) if ideal and name != "ideal" else np.inf
            allowed = max(HAND_FACTOR * hand, encoder_step_at_hand(robot))
            cells = row(name, minutes, hands, allowed)
            figure.data |= {
                f"{robot}_{name}": np.array(minutes),
                f"{robot}_{name}_hand": np.array(hands),
            }
            figure.rows.append(cells)
            rows[robot, CASES[name].title] = cells
            write_page(rows)
            print(robot, *cells, sep=" | ", flush=True)
    figure.save(draw(rows), "imperfect")
    return figure


def write_page(rows: Mapping[tuple[str, str], Row]) -> None:
    """Write a table for each robot."""
    text = []
    for robot in ROBOTS:
        links = ", ".join(f"`{link}` {force:g} N" for link, force in PUSHED[robot].items())
        known = (rows.get((robot, case.title)) for case in CASES.values())
        body = table([cells for cells in known if cells is not None], HEADS)
        text.append(f"### {robot}\n\nPushed: {links}.\n\n{body}")
    write_part(PART, "\n\n".join(text))


def color_of(name: str) -> str:
    """Return the color of a case: grey, nothing spoilt; green, as declared; orange, beyond it."""
    if name == "ideal":
        return "tab:gray"
    if name in WITHIN_DECLARED:
        return "tab:green"
    return "tab:orange" if name == "twice" else "tab:red"


def draw(rows: Mapping[tuple[str, str], Row]) -> plt.Figure:
    """Return a picture of the largest violations by robot and case."""
    titles = [case.title for case in CASES.values()]
    picture, axes = plt.subplots(
        2, len(ROBOTS), figsize=(14, 7), sharey=True, sharex="row", layout="constrained"
    )
    for line, head in zip(axes, ("position, rad", "speed, rad/s"), strict=True):
        values = {key: float(cells[HEADS.index(head)]) for key, cells in rows.items()}
        some = [value for value in values.values() if value > 0.0] or [1e-3, 1.0]
        low = 10.0 ** np.floor(np.log10(min(some)) - 1.0)
        for axis, robot in zip(line, ROBOTS, strict=True):
            for place, (name, case) in enumerate(CASES.items()):
                value, color = values.get((robot, case.title)), color_of(name)
                if value:
                    axis.barh(place, value - low, left=low, color=color)
                    axis.text(value, place, f" {value:.2g}", va="center", fontsize=8)
                elif value is not None:
                    axis.plot(1.6 * low, place, "o", mfc="none", color=color, clip_on=False)
            axis.set(xscale="log", xlim=(low, 30.0 * max(some)))
            axis.set(xlabel=f"{head.replace(',', ' beyond a limit,')}", title=robot)
            axis.set_yticks(range(len(titles)), titles, fontsize=8)
            axis.grid(axis="x", alpha=0.3)
    axes[0, 0].invert_yaxis()
    return picture


def main() -> int:
    """Play cases, write the tables, and tell whether what is declared kept all limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", nargs="?", default="all", choices=("all", *ROBOTS))
    parser.add_argument("--case", choices=tuple(CASES), help="only this row")
    parser.add_argument("--minutes", type=int, default=10, help="of each robot, as declared")
    parser.add_argument("--others", type=int, default=1, help="minutes of the other rows")
    given = parser.parse_args()
    robots = ROBOTS if given.robot == "all" else (given.robot,)
    names = (given.case,) if given.case else tuple(CASES)
    figure = play_all(robots, names, given.minutes, given.others)
    return int(any("a limit was passed" in cells[-1] for cells in figure.rows))


if __name__ == "__main__":
    raise SystemExit(main())
