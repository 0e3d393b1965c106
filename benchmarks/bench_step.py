# SPDX-License-Identifier: Apache-2.0
"""One controller step, part by part, with each solver, and against the model terms it needs.

The machine's speed cancels in the ratio of a step to the terms that Pinocchio computes for it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import yaml

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.contact.contacts import FrictionContact
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import (
    SOLVERS,
    AccelerationRange,
    InverseDynamicsQP,
    LinearConstraints,
)
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.state import State

ROOT = Path(__file__).resolve().parent.parent
BEFORE = {"same": 5.11, "other": 6.78}
"""Step over model terms of commit 9b25591, Baxter's arm, medians of 9 runs on 2 cores."""
ALLOWED = 1.25
"""What a step may take, in units of what it took then."""


def microseconds(
    functions: dict[str, Callable[[], Any]], rounds: int, repetitions: int = 300
) -> dict[str, float]:
    """Return the best mean times of calls, in turns: what each takes undisturbed."""
    best = dict.fromkeys(functions, float("inf"))
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.thread_time()
            for _ in range(repetitions):
                function()
            best[name] = min(best[name], (time.thread_time() - start) / repetitions)
    return {name: 1e6 * seconds for name, seconds in best.items()}


def model_terms(robot: RobotModel, q: np.ndarray, v: np.ndarray) -> Callable[[], None]:
    """Return what computes a step's model terms with Pinocchio and nothing else."""
    model, data, zero = robot.model, robot.model.createData(), np.zeros(robot.n)
    frame, axes = model.getFrameId(robot.frame), pin.ReferenceFrame.LOCAL

    def compute() -> None:
        pin.crba(model, data, q)
        pin.nonLinearEffects(model, data, q, v)
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, zero)
        pin.updateFramePlacement(model, data, frame)
        pin.getFrameJacobian(model, data, frame, axes)
        pin.getFrameAcceleration(model, data, frame, axes)
        pin.rnea(model, data, q, v, zero)

    return compute


def qp_alone(controller: Controller, state: State) -> dict[str, Callable[[], Any]]:
    """Return what times the QP alone, built and solved: plain, with rows, with contact forces.

    Each with the same limits active as before, and with others: bounds that change sides.
    """
    robot, n = controller.robot, controller.robot.n
    rng = np.random.default_rng(1)
    data = robot.model.createData()
    pin.computeJointJacobians(robot.model, data, state.q)
    pin.forwardKinematics(robot.model, data, state.q, state.v, np.zeros(n))
    contact = FrictionContact(robot.frame, np.zeros((1, 3)), [0.0, 0.0, -1.0], 0.5)
    pressing = np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0])
    robot.update(state, np.zeros(n))
    limits = robot.M, -controller.tau_max - robot.h, controller.tau_max - robot.h
    terms = [task.term(robot) for task in controller.goals.tasks(None)]
    five, half = np.full(n, 5.0), np.full(n, 0.5)
    wide, tight = AccelerationRange(-five, five), AccelerationRange(-half, half)
    sides = [AccelerationRange(s * half - 0.1, s * half + 0.1) for s in (1.0, -1.0)]
    # Like distances: limited below, so that the middle of the tight bounds is just allowed.
    G = rng.normal(size=(10, n))
    rows = LinearConstraints(G, -np.abs(G @ half), np.full(10, np.inf))
    too_much = rows._replace(lower=np.abs(G @ half) + 0.2)

    def with_contact() -> tuple[Any, Any]:
        return None, contact.forces(robot.model, data, pressing, 1e-3)

    timed: dict[str, Callable[[], Any]] = {}
    for name, extra in {
        "QP alone": lambda: (None, None),
        "QP with 10 rows": lambda: (rows, None),
        "QP with a contact of 4 facets": with_contact,
        "QP with both": lambda: (rows, with_contact()[1]),
    }.items():
        same, other = InverseDynamicsQP(n), InverseDynamicsQP(n)

        def again(qp=same, extra=extra) -> None:
            qp.solve(qp.build(terms, wide, *limits, *extra()))

        swapped = sides.copy()

        def off_and_on(qp=other, extra=extra, bounds=swapped) -> None:
            bounds.reverse()
            qp.solve(qp.build(terms, bounds[0], *limits, *extra()))

        timed[name] = again
        timed[f"{name}, other bounds active"] = off_and_on
    relaxed = InverseDynamicsQP(n)
    timed["QP with 10 rows and bounds that give way"] = lambda: relaxed.solve(
        relaxed.build(terms, tight, *limits, too_much)
    )
    timed["  contact Jacobian and forces"] = with_contact
    return timed


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="baxter_left_arm")
    parser.add_argument("--rounds", type=int, default=20, help="of which the best counts")
    options = parser.parse_args()
    content = yaml.safe_load((ROOT / "config" / f"{options.robot}.yaml").read_text())
    values = {k: v for part in content.values() for k, v in part["ros__parameters"].items()}
    model = build_model(read_urdf(values["robot_description"]), values["joints"])
    n = model.nv
    state = State(np.array(values["start_positions"]), np.full(n, 0.1))
    hundred, half = np.full(n, 100.0), np.full(n, 0.5)
    wide = AccelerationRange(-hundred, hundred)
    sides = [AccelerationRange(s * half - 0.1, s * half + 0.1) for s in (1.0, -1.0)]

    def make(solver: str) -> Controller:
        robot = RobotModel(model, values["end_effector_frame"], 1.0 / values["rate_hz"])
        gains = Gains(pose_kp=10.0, pose_kd=6.3, posture_kp=10.0, posture_kd=6.3)
        controller = Controller(
            robot, [Goals(robot.n, gains), JointBounds()], values["torque_max"], solver=solver
        )
        controller.reset(state.q)
        robot.update(State(state.q + 0.1, state.v), state.v)
        controller.goals.set_pose(robot.pose.copy())
        return controller

    def off_and_on(controller: Controller) -> Callable[[], Any]:
        """Return steps with bounds that change sides, so that the solver proper is needed."""
        bounds = sides.copy()

        def step() -> None:
            bounds.reverse()
            controller.step(state, bounds[0])

        return step

    def same(controller: Controller) -> Callable[[], Any]:
        return lambda: controller.step(state, wide)

    controller = make("daqp")
    robot = controller.robot
    steps: dict[str, Callable[[], Any]] = {"terms": model_terms(robot, *state)}
    for solver in SOLVERS:
        steps[f"{solver} same"] = same(make(solver))
        steps[f"{solver} other"] = off_and_on(make(solver))
    took = microseconds(steps, options.rounds)
    print(f"model terms by Pinocchio{took['terms']:>35.1f} us")
    for kind, meaning in (
        ("same", "same bounds active as before"),
        ("other", "other bounds active (solver)"),
    ):
        for solver in SOLVERS:
            time_us = took[f"{solver} {kind}"]
            ratio = time_us / took["terms"]
            line = f"step, {meaning}, {solver}"
            print(
                f"{line:<50} {time_us:8.1f} us, {ratio:5.2f} of the terms"
                f" = {ratio / BEFORE[kind]:.2f} of commit 9b25591 (at most {ALLOWED})"
            )
    parts = {
        "  model at the current state": lambda: robot.update(state, state.v),
        "  torque of the middle of the step": lambda: robot.torque(state.v),
        "  limits and rate of torque": lambda: controller._limiter.limited(controller.tau_max),
    }
    for name, time_us in microseconds(parts | qp_alone(controller, state), options.rounds).items():
        print(f"{name:<50} {time_us:8.1f} us")


if __name__ == "__main__":
    main()
