"""One controller step, part by part, and the acceleration bounds beside it."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
import yaml

from torque_safety_controller.contact.contacts import Contacts, FrictionContact
from torque_safety_controller.controller import Controller, Gains
from torque_safety_controller.qp.constraints import Rows
from torque_safety_controller.qp.inverse_dynamics_qp import InverseDynamicsQP
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.robot_description import build_model, read_urdf

ROOT = Path(__file__).resolve().parent.parent


def microseconds(function, repetitions: int = 2000, rounds: int = 7) -> float:
    """Return the best mean time of a call over several rounds: what it takes undisturbed."""
    best = float("inf")
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(repetitions):
            function()
        best = min(best, (time.perf_counter() - start) / repetitions)
    return 1e6 * best


def qp_alone(controller: Controller, q: np.ndarray, v: np.ndarray) -> dict:
    """Return what times the QP alone: plain, with rows, with contact forces.

    Each with the same limits active as before, and with others: bounds that change sides.
    """
    robot, n = controller.robot, controller.robot.n
    rng = np.random.default_rng(1)
    data = robot.model.createData()
    pin.computeJointJacobians(robot.model, data, q)
    pin.forwardKinematics(robot.model, data, q, v, np.zeros(n))
    contacts = Contacts(
        robot.model, [FrictionContact(robot.frame, np.zeros(3), [0.0, 0.0, -1.0], 0.5, 4)]
    )
    task = contacts.wrench_task(0, np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0]), 1e-3)
    robot.update(q, v, np.zeros(n))
    limits = robot.M, -controller.tau_max - robot.h, controller.tau_max - robot.h
    tasks = controller.goals.tasks(robot, q, v, controller.gains)
    wide, tight = np.full(n, 5.0), np.full(n, 0.5)
    # Like distances: limited below, so that the middle of the tight bounds is just allowed.
    G = rng.normal(size=(10, n))
    rows = Rows(G, -np.abs(G @ tight), np.full(10, np.inf))
    too_much = rows._replace(lower=np.abs(G @ tight) + 0.2)

    def with_contact() -> tuple:
        contacts.update(data)
        return None, contacts.forces([task])

    timed = {}
    for name, extra in {
        "QP alone": lambda: (None, None),
        "QP with 10 rows": lambda: (rows, None),
        "QP with a contact of 4 facets": with_contact,
        "QP with both": lambda: (rows, with_contact()[1]),
    }.items():
        same, other = InverseDynamicsQP(n), InverseDynamicsQP(n)
        sign = [1.0]

        def again(qp=same, extra=extra) -> None:
            qp.solve(tasks, -wide, wide, *limits, *extra())

        def off_and_on(qp=other, extra=extra, sign=sign) -> None:
            sign[0] = -sign[0]
            qp.solve(tasks, sign[0] * tight - 0.1, sign[0] * tight + 0.1, *limits, *extra())

        timed[name] = again
        timed[f"{name}, other bounds active"] = off_and_on
    relaxed = InverseDynamicsQP(n)
    timed["QP with 10 rows and bounds that give way"] = lambda: relaxed.solve(
        tasks, -tight, tight, *limits, too_much
    )
    timed["  contact Jacobian and forces"] = with_contact
    return timed


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="baxter_left_arm")
    options = parser.parse_args()
    content = yaml.safe_load((ROOT / "config" / f"{options.robot}.yaml").read_text())
    values = {k: v for part in content.values() for k, v in part["ros__parameters"].items()}
    model = build_model(read_urdf(values["robot_description"]), values["joints"])
    n = model.nv
    robot = RobotModel(model, values["end_effector_frame"], 1.0 / values["rate_hz"])
    tau_max = np.array(values["torque_max"])
    controller = Controller(robot, tau_max, Gains(10.0, 6.3, 1.0, 10.0, 6.3, 1e-3, True, 20.0))
    q = np.array(values["start_positions"])
    v = np.full(n, 0.1)
    controller.start(q)
    robot.update(q + 0.1, v, v)
    controller.set_pose_goal(robot.pose.copy())
    wide, tight = np.full(n, 100.0), np.full(n, 0.5)

    def off_and_on() -> None:
        # Bounds that change sides each time, so that the solver proper is needed.
        off_and_on.sign = -off_and_on.sign
        controller.step(q, v, off_and_on.sign * tight - 0.1, off_and_on.sign * tight + 0.1)

    off_and_on.sign = 1.0
    rows = {
        "step, same bounds active as before": lambda: controller.step(q, v, -wide, wide),
        "step, other bounds active (solver)": off_and_on,
        "  model at the current state": lambda: robot.update(q, v, v),
        "  torque of the middle of the step": lambda: robot.torque(q, v, v),
        "  limits and rate of torque": lambda: controller._limiter.limited(tau_max),
    }
    rows |= qp_alone(controller, q, v)
    for name, function in rows.items():
        print(f"{name:<50} {microseconds(function):8.1f} us")


if __name__ == "__main__":
    main()
