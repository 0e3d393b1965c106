# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a URDF is told by name, in the parameters of a node too."""

import numpy as np
import pytest

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot.configuration import (
    RobotConfiguration,
    check_with_urdf,
    load_model,
)
from viability_bounds_pkg.robot.files import RobotDescriptionError, check_urdf, read_urdf
from viability_bounds_pkg.testing.two_joint_robot import URDF

LIMITS = 'lower="-1" upper="2" effort="30" velocity="4"'
ROBOT = URDF.format(
    limit=f"<limit {LIMITS}/>", type="revolute", mass=2.0, hand_mass=0.5, limits=LIMITS
)
HAND = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
ZERO = 'ixx="0" iyy="0" izz="0"'


def moments(ixx, iyy, izz):
    return ROBOT.replace(HAND, HAND.replace(ZERO, f'ixx="{ixx}" iyy="{iyy}" izz="{izz}"'))


def robot(folder, text, rotors=(0.0, 0.0)):
    """Parameters of a robot with a URDF, and its text."""
    path = folder / "arm.urdf"
    path.write_text(text)
    joints = ("shoulder", "wrist")
    config = RobotConfiguration(
        robot_description=str(path), joints=joints, rotor_inertia=np.array(rotors)
    )
    return config, config.read_urdf()


def test_a_right_urdf_has_no_mistakes():
    check_urdf(ROBOT, "arm.urdf")
    check_urdf(ROBOT.replace('"hand"', '"wrist"'), "arm.urdf")  # of a link and of a joint
    check_urdf(ROBOT.replace('parent link="arm"', 'parent link="base"', 1), "arm.urdf")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (ROBOT.replace("</robot>", '<link name="table"/></robot>'), "'base' and 'table' hang on"),
        (ROBOT.replace(' name="arm">', ">", 1), "<robot> has no name"),
        (ROBOT.replace('<link name="base"/>', "<link/>"), "a link has no name: number 1"),
        (ROBOT.replace('"wrist"', '"shoulder"'), "joint 'shoulder' is there 2 times"),
        (ROBOT.replace("</robot>", '<link name="arm"/></robot>'), "link 'arm' is there 2 times"),
        (ROBOT.replace('"wrist" type="revolute"', '"wrist" type="hinge"'), "of type 'hinge'"),
        (ROBOT.replace('"wrist" type="revolute"', '"wrist"'), "joint 'wrist' has no type"),
        (ROBOT.replace('"0 1 0"', '"0 0 0"'), "joint 'wrist' has an axis without a direction"),
        (ROBOT.replace('child link="hand"', 'child link="hnad"'), "which is not there; did you"),
        (ROBOT.replace('"2.0"', '"1,5"'), "link 'arm': <mass value='1,5'>: no number"),
        (ROBOT.replace('parent link="base"', 'parent link="hand"'), "link 'arm' hangs on itself"),
    ],
)
def test_a_mistake_is_named(given, words):
    with pytest.raises(RobotDescriptionError) as error:
        check_urdf(given, "arm.urdf")
    assert words in str(error.value)
    assert str(error.value).startswith("arm.urdf: ")


def test_all_mistakes_are_in_one_line():
    given = ROBOT.replace('"wrist" type="revolute"', '"wrist"').replace('"2.0"', '"1,5"')
    with pytest.raises(RobotDescriptionError, match="no number; joint 'wrist' has no type"):
        check_urdf(given, "arm.urdf")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (ROBOT.replace('"0.5"', '"0"'), "'wrist' moves no inertia: link 'hand' has no <inertial>"),
        (ROBOT.replace('"0.5"', '"-1"'), "link 'hand' has a mass of -1 kg"),
        (ROBOT.replace('<mass value="0.5"/>', ""), "'hand' has an <inertial> without <mass"),
        (ROBOT.replace(HAND, HAND.replace(' izz="0"', "")), "<inertia> without izz"),
        (moments(-0.01, 0.01, 0.005), "'hand' has a negative moment of inertia: .* -0.01, 0.005,"),
    ],
)
def test_inertias_of_links_that_move_are_checked(tmp_path, given, words):
    with pytest.raises(SettingError, match=f"'robot_description' is .*{words}"):
        load_model(*robot(tmp_path, given))


def test_moments_that_no_body_has_are_warned_of(tmp_path):
    config, urdf = robot(tmp_path, moments(0.01, 0.01, 0.03))
    (line,) = check_with_urdf(config, urdf)
    assert line.startswith("link 'hand' has moments of inertia that no body has: about its main")
    assert not check_with_urdf(config, moments(0.01, 0.01, 0.0201))  # rounded


def test_a_rotor_moves_a_joint_without_another_inertia(tmp_path):
    massless = ROBOT.replace('"0.5"', '"0"')
    assert load_model(*robot(tmp_path, massless, (0.0, 0.1))).nv == 2


def test_a_file_in_another_encoding_is_read(tmp_path):
    path = tmp_path / "arm.urdf"
    text = f'<?xml version="1.0" encoding="GB2312"?><!-- \u673a\u5668 -->{ROBOT.strip()}'
    path.write_bytes(text.encode("gb2312"))
    assert read_urdf(str(path)) == text
    path.write_bytes(text.replace("GB2312", "GB99").encode("gb2312"))
    with pytest.raises(RobotDescriptionError, match="is not in GB99, nor in UTF-8; iconv -f"):
        read_urdf(str(path))


def test_meshes_of_the_package_around_a_urdf_are_found(tmp_path, monkeypatch):
    folder = tmp_path / "described"
    (folder / "urdf" / "arms").mkdir(parents=True)
    (folder / "package.xml").write_text("<package><name>described</name></package>")
    path = folder / "urdf" / "arms" / "arm.urdf"
    path.write_text(f"{ROBOT}<!-- package://described/meshes/a.stl package://other/b.stl -->")
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    assert f"<!-- file://{folder}/meshes/a.stl package://other/b.stl -->" in read_urdf(str(path))
    (tmp_path / "other").mkdir()  # beside the package
    assert f"file://{tmp_path}/other/b.stl" in read_urdf(str(path))
    (folder / "package.xml").unlink()  # its name tells enough
    assert f"file://{folder}/meshes/a.stl" in read_urdf(str(path))
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))  # as if it was installed
    assert "package://described/meshes/a.stl" in read_urdf(str(path))


def test_meshes_beside_a_urdf_are_found(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.stl").touch()
    path = tmp_path / "arm.urdf"
    path.write_text(f'{ROBOT}<!-- <mesh filename="meshes/a.stl"/> <mesh filename="b.stl"/> -->')
    found = f'<mesh filename="file://{tmp_path}/meshes/a.stl"/> <mesh filename="b.stl"/>'
    assert found in read_urdf(str(path))
