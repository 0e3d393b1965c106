# SPDX-License-Identifier: Apache-2.0
"""What is found in a URDF, what is estimated from it, and what is refused."""

import sys
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import yaml

from torque_safety_controller.new_robot.chain import NewRobotError, find_chain
from torque_safety_controller.new_robot.estimates import estimate
from torque_safety_controller.new_robot.postures import SelfCollisions, find_postures
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tools.new_robot import main
from viability_bounds_pkg.cli.limits_file import NODE
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter_files import node_parameters, read_files
from viability_bounds_pkg.robot.description import load_geometry
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.state import State

ROBOTS = "package://example-robot-data/robots/"
UR5 = ROBOTS + "ur_description/urdf/ur5_robot.urdf"
KINOVA = ROBOTS + "kinova_description/robots/kinova.urdf"
BAXTER = ROBOTS + "baxter_description/urdf/baxter.urdf"
PANDA = ROBOTS + "panda_description/urdf/panda.urdf"
ARMS = {
    "ur5": (UR5, "tool0"),
    "panda": (PANDA, "panda_hand"),
    "kinova": (KINOVA, "j2s6s200_end_effector"),
    "baxter": (BAXTER, "left_gripper"),
}


@cache
def chain_of(name):
    urdf, tip = ARMS[name]
    return find_chain(read_urdf(urdf), [tip])


@cache
def estimates_of(name):
    return estimate(chain_of(name))


def room(chain, estimates, rng, count):
    """Accelerations that torque leaves up and down, each of shape (count, n), by inverse dynamics.

    Half of the states are corners of the limits, where the worst ones are.
    """
    n, data = len(chain.joints), chain.model.createData()
    low = np.where(chain.continuous, -np.pi, chain.q_min)
    high = np.where(chain.continuous, np.pi, chain.q_max)
    up, down = np.empty((count, n)), np.empty((count, n))
    for k in range(count):
        share, v_share = rng.random(n), rng.uniform(-1.0, 1.0, n)
        if k % 2:
            share, v_share = np.where(rng.random(n) < 0.5, share.round(), share), np.sign(v_share)
        q, v = low + share * (high - low), v_share * estimates.v_max
        h = pin.nonLinearEffects(chain.model, data, q, v)
        inertia = np.diag(pin.crba(chain.model, data, q))
        up[k], down[k] = (chain.tau_max - h) / inertia, (chain.tau_max + h) / inertia
    return up, down


@pytest.mark.parametrize("name", ["ur5", pytest.param("panda", marks=pytest.mark.long)])
def test_limits_are_available_in_every_state_tried_and_no_smaller_than_need_be(name):
    chain, estimates = chain_of(name), estimates_of(name)
    assert not estimates.filtered.any()
    up, down = room(chain, estimates, np.random.default_rng(1), 3000)
    assert (up >= estimates.a_max).all()
    assert (down >= -estimates.a_min).all()
    assert (estimates.v_max <= chain.v_max).all()
    if name == "ur5":
        assert estimates.speed_scale == 1.0
        assert (estimates.a_max == 15.0).all()  # more is of little use
    else:
        # At the URDF's speeds Panda's second joint has none; config/panda.yaml has 3 rad/s^2.
        assert 0.7 < estimates.speed_scale < 0.8
        assert 2.7 < estimates.a_max[1] < 4.5


@pytest.mark.long
def test_a_weak_motor_gets_the_safety_filter_and_limits_of_most_states():
    chain, estimates = chain_of("baxter"), estimates_of("baxter")
    assert [n for n, f in zip(chain.joints, estimates.filtered, strict=True) if f] == ["left_s1"]
    up, down = room(chain, estimates, np.random.default_rng(1), 4000)
    random = slice(0, None, 2)  # those that are no corners
    available = np.minimum(up, down)[random, 1] >= estimates.a_max[1]
    assert 0.75 < available.mean() < 1.0
    assert "left_s1" in estimates.why


def test_joints_without_end_have_no_position_limits_and_two_arms_are_one_chain():
    chain = chain_of("kinova")
    assert chain.continuous.sum() == 3
    assert np.isinf(chain.q_max[chain.continuous]).all()
    assert np.isfinite(chain.q_max[~chain.continuous]).all()
    chain = find_chain(read_urdf(BAXTER), ["left_gripper", "right_gripper"])
    assert len(chain.joints) == 14
    assert chain.tips[0] == "left_gripper"


def test_start_and_goals_are_free_of_collisions_and_can_be_held():
    chain = chain_of("ur5")
    touches = SelfCollisions(chain, load_geometry(read_urdf(UR5), chain.model))
    assert touches.pairs > 5
    postures = find_postures(chain, touches)
    assert postures.reached.sum() >= 6
    for q in (postures.start, *postures.goals):
        assert not touches(q)
        gravity = pin.computeGeneralizedGravity(chain.model, chain.model.createData(), q)
        assert (np.abs(gravity) <= 0.9 * chain.tau_max).all()
    folded = np.array([0.0, -1.5, np.pi, 0.0, 0.0, 0.0])  # the forearm in the upper arm
    assert touches(folded)


LIMIT = '<limit lower="-1" upper="2" effort="30" velocity="4"/>'
LINK = (
    '<link name="{}"><inertial><origin xyz="0 0 -0.2"/><mass value="{}"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)


def urdf(kind="revolute", limit=LIMIT, more="", mass=1.0):
    """An arm of two joints, the second as given."""
    second = LINK.format("hand", mass) if mass else '<link name="hand"/>'
    return f"""<robot name="an arm"><link name="base"/>{LINK.format("upper", 2.0)}{second}
    <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/>{LIMIT}</joint>
    <joint name="wrist" type="{kind}"><parent link="upper"/><child link="hand"/>
    <origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/>{limit}</joint>{more}</robot>"""


FINGER = (
    '<link name="finger"/><joint name="finger" type="revolute"><parent link="hand"/>'
    f'<child link="finger"/><axis xyz="0 1 0"/>{LIMIT}<mimic joint="{{}}"/></joint>'
)
BALL = (
    '<link name="ball"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>'
    '<joint name="grip" type="fixed"><parent link="hand"/><child link="ball"/></joint>'
)
THUMB = (
    '<link name="thumb"/><joint name="thumb" type="prismatic"><parent link="upper"/>'
    f'<child link="thumb"/><axis xyz="0 1 0"/>{LIMIT}</joint>'
)
CURVED = (
    f'{LIMIT}<position_based_velocity_limits deceleration_limit="6.0" velocity_offset="0.652"/>'
)
LOOP = '<joint name="rod" type="fixed"><parent link="base"/><child link="hand"/></joint>'


@pytest.mark.parametrize(
    ("given", "tip", "base", "words"),
    [
        (urdf(), "hnad", "", ["no link 'hnad'", "did you mean 'hand'"]),
        (urdf(), "upper", "", ["only joint 'shoulder' moves", "two or more"]),
        (urdf(), "upper", "hand", ["does not hang on 'hand'"]),
        (urdf(limit=LIMIT.replace('effort="30"', "")), "hand", "", ["wrist", "no effort limit"]),
        (urdf(limit=LIMIT.replace('"4"', '"0"')), "hand", "", ["wrist", "velocity", "data sheet"]),
        (urdf(limit=LIMIT.replace('"2"', '"-1"')), "hand", "", ["no room", "continuous"]),
        (urdf(limit=CURVED.replace("6.0", "six")), "hand", "", ["wrist", "'six' for dece"]),
        (
            urdf(limit=CURVED.replace("velocity_o", "o")),
            "hand",
            "",
            ["nothing", "at least 0"],
        ),
        (
            urdf(limit=CURVED.replace("0.652", "5")),
            "hand",
            "",
            ["no place to move", "4.17"],
        ),
        (urdf(mass=0), "hand", "", ["'wrist' moves no inertia", "<inertial>"]),
        (urdf(more=LOOP), "hand", "", ["closed loop", "'wrist' and 'rod'"]),
        (urdf(more=FINGER.format("wrist")), "finger", "", ["mimics another", "tip hand"]),
        (urdf(kind="prismatic", more=THUMB), "hand", "", ["fingers wrist and thumb", "tip upper"]),
        (urdf(kind="floating", limit=""), "hand", "", ["floating", "--base hand"]),
    ],
)
def test_what_cannot_work_says_why_and_what_to_do(given, tip, base, words):
    with pytest.raises(NewRobotError) as error:
        find_chain(given, [tip], base)
    text = str(error.value)
    assert "\n" not in text
    for word in words:
        assert word in text


def test_all_mistakes_are_told_at_once_a_line_each():
    given = urdf(limit=LIMIT.replace('effort="30"', ""), mass=-1.0)
    given = given.replace('"shoulder" type="revolute"', '"shoulder" type="hinge"')
    with pytest.raises(NewRobotError) as error:
        find_chain(given, ["hand"])
    kind, limit, mass = str(error.value).splitlines()
    assert kind.startswith("joint 'shoulder' is of type 'hinge'; it must be one of revolute,")
    assert "joint 'wrist' has no effort limit" in limit
    assert mass == "link 'hand' has a mass of -1 kg"
    bare = urdf(more=FINGER.format("wrist"), mass=0).replace('effort="30"', "")
    with pytest.raises(NewRobotError) as error:  # a gripper hides nothing of other joints
        find_chain(bare.replace('"2.0"', '"0"'), ["finger"])
    gripper, limit, mass = str(error.value).splitlines()
    assert "'finger' mimics another" in gripper
    assert limit.startswith("joints 'shoulder', 'wrist' have no effort limit")
    assert mass.startswith(
        "joints 'shoulder', 'wrist' move no inertia: links 'upper', 'hand' have"
    )


def test_a_joint_that_slides_at_the_end_is_no_gripper_and_has_its_units():
    chain = find_chain(urdf(kind="prismatic"), ["hand"])
    assert [chain.units(j) for j in range(2)] == [("rad", "N m"), ("m", "N")]
    with pytest.raises(NewRobotError, match="'wrist': its effort limit of 0.5 N does.* m/s"):
        estimate(find_chain(urdf(kind="prismatic", limit=LIMIT.replace("30", "0.5")), ["hand"]))


def test_a_joint_that_carries_too_much_in_every_posture_is_named():
    given = urdf(kind="prismatic", limit=LIMIT.replace("30", "15")).replace('"0 1 0"', '"0 0 1"')
    chain = find_chain(given, ["hand"])  # 1 kg on 15 N
    with pytest.raises(NewRobotError, match="'wrist': to hold .* 65% of its effort .* --base"):
        find_postures(chain, SelfCollisions(chain, pin.GeometryModel()))


def test_a_speed_limit_that_is_none_is_asked_for():
    fast = urdf(limit=LIMIT.replace('"4"', '"50000"'))
    with pytest.raises(
        NewRobotError, match="'wrist' has 50000 as .*no limit: give --velocity-max"
    ):
        find_chain(fast, ["hand"])
    assert find_chain(fast, ["hand"], velocity_max=3.0).v_max.tolist() == [3.0, 3.0]


def test_links_and_joints_may_have_the_same_names():
    given = urdf(more=BALL).replace('"wrist"', '"upper"').replace('"grip"', '"ball"')
    chain = find_chain(given, ["ball"])
    assert chain.joints == ("shoulder", "upper")
    model, q = chain.model, np.array([0.3, 0.4])
    robot = RobotModel(model, "ball", 0.0)
    robot.update(State(q, np.zeros(2)), np.zeros(2))
    x, _, z = robot.pose.translation
    np.testing.assert_allclose([x, z], [-0.4 * np.sin(0.3), -0.4 * np.cos(0.3)], atol=1e-12)  # m
    assert load_geometry(given, model).ngeoms == 1
    find_postures(chain, SelfCollisions(chain, load_geometry(given, model)))


def test_a_motor_that_is_too_weak_is_named():
    chain = find_chain(urdf(limit=LIMIT.replace("30", "0.5")), ["hand"])
    with pytest.raises(NewRobotError, match="'wrist': its effort limit of 0.5 N m"):
        estimate(chain)


# The tool


def run(folder, text, *arguments, name="arm.urdf"):
    """Write a URDF and run the tool."""
    path = folder / name
    path.write_text(text)
    return main([str(path), *arguments, "--out", str(folder)])


def test_the_tool_refuses_in_one_line(tmp_path, capsys):
    assert run(tmp_path, urdf(), "no_link") == 1
    assert main([str(tmp_path / "none.urdf"), "hand", "--out", str(tmp_path)]) == 1
    xacro = '<robot xmlns:xacro="x"><xacro:arm/></robot>'
    assert run(tmp_path, xacro, "hand", name="arm.xacro") == 1
    errors = capsys.readouterr().err.splitlines()
    assert [line.startswith("new_robot: ") for line in errors] == [True, True, True]
    assert "no_link" in errors[0]
    assert "none.urdf" in errors[1]
    assert errors[2].endswith("fails: unknown macro name: xacro:arm; give it what it asks for")
    assert not list(tmp_path.rglob("*.yaml"))
    with pytest.raises(SystemExit):
        main([str(tmp_path / "arm.urdf"), "hand", "--topic"])
    assert "either a URDF or --topic" in capsys.readouterr().err


def test_a_file_for_xacro_is_expanded(tmp_path, monkeypatch, capsys):
    mass = '<mass value="2.0"'
    text = urdf().replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    begin = text.index(">", text.index("<robot")) + 1
    text = f'{text[:begin]}<xacro:property name="m" value="4"/>{text[begin:]}'
    text = text.replace(mass, '<mass value="${m / 2}"')
    assert run(tmp_path, text, "hand", "--name", "arm", name="arm.urdf.xacro") == 0
    assert mass in (tmp_path / "arm.urdf").read_text()
    monkeypatch.setitem(sys.modules, "xacro", None)  # as if it was not there
    assert run(tmp_path, text, "hand", "--name", "b", name="arm.urdf.xacro") == 1
    assert "pip install xacro, or apt install ros-jazzy-xacro" in capsys.readouterr().err


def test_a_xacro_file_gets_arguments_and_finds_packages(tmp_path, monkeypatch, capsys):
    head = '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    for name in ("ros", "ament/share"):
        (tmp_path / name / "described").mkdir(parents=True)
        part = urdf().replace('effort="30"', 'effort="$(arg effort)"', 1)
        inside = part[part.index(">") + 1 :]
        (tmp_path / name / "described" / "arm.xacro").write_text(f"<robot>{inside}")
    include = '<xacro:include filename="$(find described)/arm.xacro"/></robot>'
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    assert run(tmp_path, head + include, "hand", "effort:=30", name="a.xacro") == 1
    assert "no package 'described' in the folders of ROS_" in capsys.readouterr().err
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ros"))
    assert run(tmp_path, head + include, "hand", name="a.xacro") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("a.xacro fails: it has no argument 'effort'; give effort:=VALUE")
    more = '<xacro:arg name="name" default="arm"/><a b="$(arg b)" c="$(arg c)"/><!-- $(arg d) -->'
    named = head.replace('name="arm"', 'name="$(arg name)"') + more + include
    assert run(tmp_path, named, "hand", name="a.xacro") == 1
    assert "no argument 'b', 'c'; give b:=VALUE c:=VALUE\n" in capsys.readouterr().err
    assert run(tmp_path, head + include, "hand", "effort:=31", name="a.xacro") == 0
    assert 'effort="31"' in (tmp_path / "arm.urdf").read_text()
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ament"))
    assert run(tmp_path, head + include, "hand", "effort:=32", "--force", name="a.xacro") == 0
    assert 'effort="32"' in (tmp_path / "arm.urdf").read_text()
    assert run(tmp_path, urdf(), "hand", "effort:=30") == 1
    assert "effort: only a xacro file takes arguments" in capsys.readouterr().err


def test_a_tool_is_a_mass_on_the_tip(tmp_path, capsys):
    assert run(tmp_path, urdf(), "hand", "--tool", "2,0.1,0,-0.05") == 0
    hand = find_chain((tmp_path / "an_arm.urdf").read_text(), ["hand"]).model.inertias[2]
    assert hand.mass == pytest.approx(1.0 + 2.0)  # kg
    np.testing.assert_allclose(hand.lever, [0.2 / 3.0, 0.0, -0.1], atol=1e-12)  # m
    written = yaml.safe_load((tmp_path / "an_arm.yaml").read_text())
    source = written["/**"]["ros__parameters"]["robot_description"]
    assert source == str(tmp_path / "an_arm.urdf")
    with pytest.raises(SystemExit):
        run(tmp_path, urdf(), "hand", "--tool", "2")
    assert "--tool: must be KG,X,Y,Z, is '2'" in capsys.readouterr().err


def test_speed_limits_that_depend_on_position_are_those_of_the_urdf(tmp_path, capsys):
    assert run(tmp_path, urdf(limit=CURVED), "hand") == 0
    files = [tmp_path / "an_arm.yaml", tmp_path / "imperfect" / "an_arm.yaml"]
    for given in (files[:1], files):
        limits = read_files(BoundsConfiguration, given, NODE).limits
        assert limits.velocity_offset.tolist() == [0.0, 0.652]
        assert limits.deceleration_limit.tolist() == [np.inf, 6.0]


def test_an_imperfect_robot_declares_what_is_simulated(tmp_path, capsys):
    assert run(tmp_path, urdf(), "hand") == 0
    files = [tmp_path / "an_arm.yaml", tmp_path / "imperfect" / "an_arm.yaml"]
    declared = read_files(BoundsConfiguration, files, NODE)
    make_bounds(declared)  # would raise where the errors leave none
    real = node_parameters(files, "bullet_node")
    known = declared.declared
    assert (known.position_error >= 0.5 * np.array(real["encoder_resolution"])).all()
    assert known.delay == real["command_delay"] == 1
    assert known.missed_deadlines == real["missed_in_row"] == real["command_timeout"] == 4
    assert known.motor_bandwidth.tolist() == real["motor_bandwidth"]
    model = find_chain(urdf(), ["hand"]).model
    model.armature = np.array(real["rotor_inertia"])
    rng, data, tau_max = np.random.default_rng(3), model.createData(), 30.0  # N m
    beyond = []
    for _ in range(2000):
        q, v = rng.uniform([-1.0, -1.0], [2.0, 2.0]), rng.uniform(-4.0, 4.0, 2)
        tau = pin.rnea(model, data, q, v, rng.uniform(real["acceleration_min"], 15.0))
        wrong = real["torque_constant_error"] * np.clip(tau, -tau_max, tau_max)
        wrong += rng.uniform(-1.0, 1.0, 2) * real["torque_ripple"] * tau_max
        wrong -= np.sign(v) * real["friction_coulomb"]
        error = np.abs(np.linalg.solve(pin.crba(model, data, q), wrong))
        beyond.append((error > known.acceleration_disturbance).any())
    assert np.mean(beyond) < 0.01  # declared are 999 of 1000 states of each joint
    assert run(tmp_path, urdf(), "hand", "--ideal", "--name", "exact") == 0
    assert not (tmp_path / "imperfect" / "exact.yaml").exists()


def test_a_slow_rate_works_and_nothing_is_left_behind_when_none_does(tmp_path, capsys):
    out = tmp_path / "out"
    path = tmp_path / "arm.urdf"
    path.write_text(urdf())
    assert main([str(path), "hand", "--rate", "20", "--out", str(out)]) == 0
    written = yaml.safe_load((out / "an_arm.yaml").read_text())
    assert written["/**"]["ros__parameters"]["rate_hz"] == 20.0
    none = tmp_path / "none"
    assert main([str(path), "hand", "--rate", "1", "--out", str(none)]) == 1
    assert not none.exists()


def test_files_are_not_replaced_unasked_and_say_where_numbers_come_from(tmp_path, capsys):
    text = urdf(more=BALL).replace("</robot>", "<!-- <xacro:if> in a comment is none\n--></robot>")
    assert run(tmp_path, text, "hand") == 0
    assert run(tmp_path, text, "hand") == 1
    assert "exists; --force replaces it" in capsys.readouterr().err
    written = (tmp_path / "an_arm.yaml").read_text()
    values = yaml.safe_load(written)["/**"]["ros__parameters"]
    assert values["joints"] == ["shoulder", "wrist"]
    assert "torque_max" not in values  # the URDF has it
    own = yaml.safe_load(written)["/**/controller_node"]["ros__parameters"]
    assert any(entry.startswith("{link: ball, ") for entry in own["collision_capsules"])
    lines = [line.strip() for line in written.splitlines()]
    for name in ("rate_hz", "start_positions", "acceleration_min", "acceleration_drift"):
        index = next(i for i, line in enumerate(lines) if line.startswith(f"{name}:"))
        assert lines[index - 1].startswith("#"), name
    (scenario,) = (tmp_path / "scenarios").iterdir()
    assert yaml.safe_load(scenario.read_text())
