# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml

from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.estimate.worst_case import torque_terms
from viability_bounds_pkg.parameter_files import ParameterFileError
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    build_model,
    kinematic_order,
    package_directories,
    read_urdf,
    resolve_uri,
)

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
ROTORS = np.linspace(0.0, 0.6, 7)  # kg m^2


@pytest.fixture(scope="module")
def urdf():
    return read_urdf(PANDA)


def test_rotors_are_on_the_diagonal_of_the_inertia_matrix(urdf):
    rng = np.random.default_rng(1)
    with_rotors, without = build_model(urdf, JOINTS, None, ROTORS), build_model(urdf, JOINTS)
    data, other = with_rotors.createData(), without.createData()
    for _ in range(10):
        q, v, a = rng.uniform(-2.0, 2.0, (3, 7))
        M = pin.crba(without, other, q)
        np.testing.assert_allclose(
            pin.crba(with_rotors, data, q), M + np.diag(ROTORS), rtol=1e-12, atol=1e-14
        )
        tau = pin.rnea(without, other, q, v, a) + ROTORS * a
        np.testing.assert_allclose(pin.rnea(with_rotors, data, q, v, a), tau, atol=1e-11)
        h = pin.nonLinearEffects(without, other, q, v)
        expected = np.linalg.solve(M + np.diag(ROTORS), tau - h)
        np.testing.assert_allclose(pin.aba(with_rotors, data, q, v, tau), expected, atol=1e-10)
        np.testing.assert_allclose(pin.nonLinearEffects(with_rotors, data, q, v), h, atol=1e-12)


def test_the_estimate_counts_the_rotors(urdf):
    rng = np.random.default_rng(2)
    q, v = rng.uniform(-2.0, 2.0, (2, 30, 7))
    with_rotors, without = build_model(urdf, JOINTS, None, ROTORS), build_model(urdf, JOINTS)
    h, inertia = torque_terms(with_rotors, with_rotors.createData(), q, v)
    bare_h, bare = torque_terms(without, without.createData(), q, v)
    np.testing.assert_allclose(inertia - bare, np.tile(ROTORS, (30, 1)), atol=1e-13)
    np.testing.assert_allclose(h, bare_h, atol=1e-12)


@pytest.mark.parametrize(
    "rotors", [ROTORS[:6], 0.1, [*ROTORS[:6], -0.1], [*ROTORS[:6], np.nan], [*ROTORS[:6], np.inf]]
)
def test_rotors_that_cannot_be_are_refused(urdf, rotors):
    with pytest.raises(RobotDescriptionError, match="rotor_inertia must be 7 finite numbers"):
        build_model(urdf, JOINTS, None, rotors)


@pytest.mark.parametrize("value", ["heavy", "${mass}", "nan", "1 kg"])
@pytest.mark.parametrize("element", ["mass value", "inertia ixx", "origin xyz", "axis xyz"])
def test_numbers_that_are_none_are_refused(urdf, tmp_path, element, value):
    path = tmp_path / "robot.urdf"
    path.write_text(
        urdf.replace("<link ", f'<link name="odd"><{element}="{value}"/></link><link ', 1)
    )
    with pytest.raises(RobotDescriptionError, match=f"<{element}='.*'>: no number"):
        read_urdf(str(path))


def test_joints_are_put_into_kinematic_order(urdf):
    assert kinematic_order(urdf, JOINTS[::-1]) == tuple(JOINTS)
    assert kinematic_order(urdf, [JOINTS[4], JOINTS[2]]) == (JOINTS[2], JOINTS[4])


def test_packages_are_found_however_many_slashes():
    assert resolve_uri(PANDA) == resolve_uri(PANDA.replace("//", "///"))
    assert any(Path(d / "example-robot-data").is_dir() for d in package_directories())
    with pytest.raises(RobotDescriptionError, match="no package 'nothing'"):
        resolve_uri("package:///nothing/here.urdf")


def test_limits_are_estimated_with_the_rotors_of_the_parameter_file(tmp_path):
    path = tmp_path / "robot.yaml"

    def write(rotors):
        parameters = {"robot_description": PANDA, "joints": JOINTS, "rotor_inertia": rotors}
        path.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))

    write(ROTORS.tolist())
    np.testing.assert_array_equal(read_robot(path).model.armature, ROTORS)
    write([-1.0] * 7)
    with pytest.raises(ParameterFileError, match="'rotor_inertia'.*finite numbers >= 0"):
        read_robot(path)
    write([1.0])
    with pytest.raises(ParameterFileError, match="'rotor_inertia' is .*; allowed: 7 numbers"):
        read_robot(path)
