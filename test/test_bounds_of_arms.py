# SPDX-License-Identifier: Apache-2.0
"""The bounds node with the limits and margins of the configured arms."""

import numpy as np
import pytest
from arms import load_arm
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import parameter_table, read
from viability_bounds_pkg.state_dependent.limits import StateDependentBounds
from viability_bounds_pkg.testing.ros_harness import acceleration_limits, joint_state, read_config
from viability_bounds_pkg.torque_margin import tightened, torque_margins

NODE = "bounds_node"
MS = 1_000_000


@pytest.mark.parametrize(
    "robot", [pytest.param("baxter_left_arm", marks=pytest.mark.long), "panda"]
)
def test_the_configured_margins_only_narrow_the_bounds(robot):
    values = dict.fromkeys(("acceleration_drift", "position_margin"))
    margins = read_config(robot, NODE)
    assert all(margins[name] for name in values)

    def solver(parameters):
        config = read(BoundsConfiguration, parameters)
        return config.limits, make_bounds(config, load_model=None).solve

    _, with_margins = solver(margins)
    limits, without = solver(margins | {"acceleration_drift": [], "position_margin": 0.0})
    rng = np.random.default_rng(2)
    q = rng.uniform(limits.q_min, limits.q_max, (2000, len(limits)))
    v = rng.uniform(-limits.v_max, limits.v_max, (2000, len(limits)))
    narrow, wide = with_margins(q, v), without(q, v)
    inside = narrow.viable
    assert inside.mean() > 0.2
    assert (wide.viable | ~inside).all()
    slack = 1e-9  # rad/s^2
    assert (narrow.upper <= wide.upper + slack)[inside].all()
    assert (narrow.lower >= wide.lower - slack)[inside].all()
    assert (narrow.upper < wide.upper - 1e-3)[inside].any()


PANDA = read_config("panda", NODE)
PANDA_VALUES = {
    row.name: PANDA[row.name] for row in parameter_table(BoundsConfiguration) if row.name in PANDA
}


def test_state_dependent_limits_are_those_of_the_solver(ros):
    values = PANDA_VALUES | {"acceleration_limits": "state_dependent", "state_timeout": 0.2}
    ros.start(BoundsNode, values)
    answers = ros.listen(JointTrajectory, "acceleration_limits")
    states = ros.talk(JointState, "joint_states")
    ros.hears("acceleration_limits")
    arm = load_arm("panda")
    limits = JointLimits(
        PANDA["joints"],
        arm.q_min,
        arm.q_max,
        arm.v_max,
        PANDA["acceleration_min"],
        PANDA["acceleration_max"],
    )
    margins = torque_margins(PANDA["acceleration_drift"], arm.dt)
    margins.position[:] += PANDA["position_margin"]
    solver = StateDependentBounds(
        arm.model,
        tightened(limits, margins),
        arm.tau_max,
        3.0 * np.maximum(-limits.a_min, limits.a_max),
        2.0 * arm.dt,
        margins.acceleration,
        arm.dt,
        margins.position,
    )
    wider = 0
    # Steps of 2 ms towards a limit, then one after a gap: the path of the last is forgotten.
    for k, stamp in enumerate((2, 4, 6, 8, 50)):
        q = arm.q_start.copy()
        q[1], v = 1.48 + 0.0026 * k, np.full(7, 1.3)
        ros.wait_until(
            lambda stamp=stamp: stamp * MS in answers.stamps,
            "an answer",
            each=lambda q=q, v=v, s=stamp: states.publish(
                joint_state(PANDA["joints"], s * MS, q, v)
            ),
            period=0.1,
        )
        if stamp == 50:
            solver.reset()
        bounds = solver.bounds(q, v)
        answer = answers[answers.stamps.index(stamp * MS)]
        assert answer == acceleration_limits(
            PANDA["joints"], stamp * MS, bounds.lower, bounds.upper
        )
        wider += int((bounds.upper > limits.a_max).sum())
    assert wider > 10
    ros.wait_until(lambda: "certified" in ros.reported(NODE, "steps_by_limits"), "diagnostics")


@pytest.mark.parametrize(
    ("changed", "name", "shown"),
    [
        ({"acceleration_limits": "best"}, "acceleration_limits", "worst_case, state_dependent"),
        ({"robot_description": ""}, "robot_description", "for state-dependent"),
        ({"robot_description": "/nowhere.urdf"}, "robot_description", "/nowhere.urdf"),
        ({"torque_max": [1.0]}, "torque_max", "7 numbers"),
        ({"acceleration_peak": [1.0] * 7}, "acceleration_peak", "at least that of the worst"),
        ({"acceleration_peak": [50.0]}, "acceleration_peak", "7 numbers"),
    ],
)
def test_bad_parameters_of_state_dependent_limits(shared_ros, changed, name, shown):
    values = PANDA_VALUES | {"acceleration_limits": "state_dependent"} | changed
    shared_ros.refuses_to_start(BoundsNode, values, name, shown)
