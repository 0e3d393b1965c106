# SPDX-License-Identifier: Apache-2.0
"""URDFs are found, checked, and made into models, rotors included."""

import numpy as np
import pinocchio as pin
import pytest
import yaml

from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.parameter_files import ParameterFileError
from viability_bounds_pkg.robot.configuration import RobotConfiguration, check_with_urdf
from viability_bounds_pkg.robot.description import build_model, kinematic_order
from viability_bounds_pkg.robot.files import RobotDescriptionError, read_urdf, resolve_uri

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
ROTORS = np.linspace(0.0, 0.6, 7)  # kg m^2


@pytest.fixture(scope="module")
def urdf():
    return read_urdf(PANDA)


def test_a_joint_that_slides_needs_position_limits():
    values = {"robot_description": "topic", "joints": ["lift"], "torque_max": [50.0]}
    endless = {"position_min": [-np.inf], "position_max": [np.inf]}
    config = read(RobotConfiguration, values | endless)
    assert config.continuous.all()
    urdf = '<robot name="x"><joint name="lift" type="{}"/></robot>'
    assert not check_with_urdf(config, urdf.format("continuous"))
    with pytest.raises(SettingError, match="'position_max' .* finite for lift: it slides"):
        check_with_urdf(config, urdf.format("prismatic"))


def test_speed_limits_of_the_urdf_that_are_left_out_are_told():
    values = {"robot_description": "topic", "joints": ["a"], "torque_max": [50.0]}
    values |= {"position_min": [-1.0], "position_max": [1.0]}
    urdf = """<robot name="x"><joint name="a" type="revolute"><position_based_velocity_limits
        deceleration_limit="6.0" velocity_offset="0.652"/></joint></robot>"""
    (line,) = check_with_urdf(read(RobotConfiguration, values), urdf)
    assert "of a in the URDF, 0.652 and 6, is narrower" in line
    values |= {"velocity_offset": [0.652], "deceleration_limit": [6.0]}
    assert not check_with_urdf(read(RobotConfiguration, values), urdf)
    assert not check_with_urdf(read(RobotConfiguration, values), urdf.replace("6.0", "six"))


def test_a_joint_that_is_locked_outside_its_limits_is_told():
    values = {"robot_description": "topic", "joints": ["a"], "torque_max": [50.0]}
    values |= {"position_min": [-1.0], "position_max": [1.0], "locked_joints": ["waist"]}
    urdf = """<robot name="x"><joint name="a" type="revolute"/>
        <joint name="waist" type="revolute"><limit lower="-1.3" upper="1.3"/></joint></robot>"""
    inside, outside = (
        check_with_urdf(read(RobotConfiguration, values | {"locked_positions": [q]}), urdf)
        for q in (1.3, 45.0)
    )
    assert not inside
    assert "is 45 for waist, outside its limits in the URDF, -1.3 to 1.3" in outside[0]


def test_rotors_are_on_the_diagonal_of_the_inertia_matrix(urdf):
    rng = np.random.default_rng(1)
    with_rotors, without = build_model(urdf, JOINTS, None, ROTORS), build_model(urdf, JOINTS)
    data, other = with_rotors.createData(), without.createData()
    q, v, a = rng.uniform(-2.0, 2.0, (3, 7))
    M = pin.crba(without, other, q)
    np.testing.assert_allclose(pin.crba(with_rotors, data, q), M + np.diag(ROTORS), atol=1e-12)
    tau = pin.rnea(without, other, q, v, a) + ROTORS * a
    np.testing.assert_allclose(pin.rnea(with_rotors, data, q, v, a), tau, atol=1e-11)
    np.testing.assert_allclose(pin.aba(with_rotors, data, q, v, tau), a, atol=1e-10)


@pytest.mark.parametrize(
    ("element", "value"),
    [("mass value", "heavy"), ("mass value", "1 kg"), ("inertia ixx", "nan"), ("axis xyz", "$x")],
)
def test_numbers_that_are_none_are_refused(urdf, tmp_path, element, value):
    path = tmp_path / "robot.urdf"
    odd = f'<link name="odd"><{element}="{value}"/></link>'
    path.write_text(urdf.replace("<link ", f"{odd}<link ", 1))
    with pytest.raises(RobotDescriptionError, match=f"<{element}='.*'>: no number"):
        read_urdf(str(path))


def test_joints_are_put_into_kinematic_order(urdf):
    assert kinematic_order(urdf, JOINTS[::-1]) == tuple(JOINTS)
    assert kinematic_order(urdf, [JOINTS[4], JOINTS[2]]) == (JOINTS[2], JOINTS[4])


def test_packages_are_found_however_many_slashes():
    assert resolve_uri(PANDA) == resolve_uri(PANDA.replace("//", "///"))
    with pytest.raises(RobotDescriptionError, match="no package 'nothing'"):
        resolve_uri("package:///nothing/here.urdf")


def test_a_package_of_python_holds_files_too(tmp_path, monkeypatch):
    (tmp_path / "some_robot" / "assets").mkdir(parents=True)
    (tmp_path / "some_robot" / "assets" / "arm.urdf").write_text("<robot name='a'/>")
    monkeypatch.syspath_prepend(tmp_path)
    found = resolve_uri("package://some_robot/assets/arm.urdf")
    assert found == tmp_path / "some_robot" / "assets" / "arm.urdf"


def test_rotors_of_a_parameter_file_reach_the_model(tmp_path):
    path = tmp_path / "robot.yaml"

    def robot(rotors):
        parameters = {"robot_description": PANDA, "joints": JOINTS, "rotor_inertia": rotors}
        path.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
        return read_robot(path)

    np.testing.assert_array_equal(robot(ROTORS.tolist()).model.armature, ROTORS)
    with pytest.raises(ParameterFileError, match="'rotor_inertia'.*finite numbers >= 0"):
        robot([-1.0] * 7)
    with pytest.raises(ParameterFileError, match="'rotor_inertia' is .*; allowed: 7 numbers"):
        robot([1.0])
