# SPDX-License-Identifier: Apache-2.0
"""Renders a robot and the obstacles around it, without a display."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import fromstring, tostring

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.bullet.client import BulletClient, finite_vector, pybullet, silenced
from sim_bridge.bullet.obstacles import Obstacle
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.files import resolve_uri

_OVERSAMPLING = 2  # PyBullet's renderer does not smooth edges
_NEAR, _FAR = 0.05, 20.0  # m
_OBSTACLE_COLOR = (0.25, 0.45, 0.7)
_FLOOR_COLOR = (0.8, 0.8, 0.78)
_SKY_TOP, _SKY_BOTTOM = np.array([214, 224, 236]), np.array([250, 250, 250])
_LIGHT = {
    "lightDirection": (1.5, 1.0, 3.0),
    "lightColor": (1.0, 1.0, 1.0),
    "lightDistance": 4.0,
    "lightAmbientCoeff": 0.55,
    "lightDiffuseCoeff": 0.5,
    "lightSpecularCoeff": 0.1,
    "shadow": 1,
}


class Camera:
    """Renders a robot with its meshes, in a PyBullet world of its own.

    The robot's world is not changed. Call `close` after use; `contextlib.closing` does.

    Args:
        robot: its obstacles are rendered.
        floor: height of a floor plate, m.
    """

    def __init__(self, robot: BulletRobot, floor: float) -> None:
        self._robot = robot
        urdf, _, _ = robot.description
        self._bullet = bullet = BulletClient()
        with silenced(1), silenced(2):
            self._body = body = bullet.load_urdf(_visuals_of(urdf))
        indices = {info.name: info.id for info in bullet.joint_infos(body)}
        self._joints = [indices[name] for name in robot.joints]
        for name, position in robot.locked.items():
            bullet.resetJointState(body, indices[name], position)
        for shape in bullet.getVisualShapeData(body):
            # Mirrored meshes would be seen from inside.
            bullet.changeVisualShape(body, shape[1], flags=pybullet.VISUAL_SHAPE_DOUBLE_SIDED)
        self._shown: list[int] = []  # bodies of the obstacles in the last picture
        plate = Obstacle("floor", "box", [3.0, 3.0, 0.04], [0.0, 0.0, floor - 0.02])
        self._add_body(plate, _FLOOR_COLOR)

    def snapshot(
        self,
        eye: ArrayLike,
        target: ArrayLike,
        size: tuple[int, int],
        q: ArrayLike,
        angle: float,
    ) -> NDArray[np.uint8]:
        """Render a picture.

        Args:
            eye: position of the camera in the frame of the robot's root link, shape (3,), m.
            target: point in the middle of the picture, shape (3,), m.
            size: width and height, pixels.
            q: positions of the joints, shape (n,), rad.
            angle: vertical field of view, degrees.

        Returns:
            Red, green and blue, shape (height, width, 3), uint8.
        """
        bullet = self._bullet
        positions = finite_vector("q", q, len(self._joints)).tolist()
        for joint, position in zip(self._joints, positions, strict=True):
            bullet.resetJointState(self._body, joint, position)
        for shown in self._shown:
            bullet.removeBody(shown)
        self._shown = [
            self._add_body(obstacle, _OBSTACLE_COLOR)
            for obstacle in self._robot.obstacles.present.values()
        ]
        eye, target = finite_vector("eye", eye, 3), finite_vector("target", target, 3)
        width, height = (_OVERSAMPLING * pixels for pixels in size)
        image = bullet.getCameraImage(
            width,
            height,
            bullet.computeViewMatrix(eye.tolist(), target.tolist(), [0.0, 0.0, 1.0]),
            bullet.computeProjectionMatrixFOV(angle, width / height, _NEAR, _FAR),
            renderer=pybullet.ER_TINY_RENDERER,
            **_LIGHT,
        )
        picture = np.reshape(image[2], (height, width, 4))[:, :, :3].astype(float)
        nothing = np.reshape(image[4], (height, width)) < 0
        sky = np.linspace(_SKY_TOP, _SKY_BOTTOM, height)[:, None, :]
        picture = np.where(nothing[:, :, None], sky, picture)
        blocks = picture.reshape(size[1], _OVERSAMPLING, size[0], _OVERSAMPLING, 3)
        return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)

    def _add_body(self, obstacle: Obstacle, color: Sequence[float]) -> int:
        arguments = obstacle.pybullet_shape()
        if "height" in arguments:
            arguments["length"] = arguments.pop("height")
        shape = self._bullet.createVisualShape(**arguments, rgbaColor=(*color, 1.0))
        body: int = self._bullet.createMultiBody(
            0.0, -1, shape, obstacle.position.tolist(), obstacle.orientation.tolist()
        )
        return body

    def close(self) -> None:
        """Disconnect from PyBullet; the camera cannot be used afterwards."""
        self._bullet.disconnect()


def _visuals_of(urdf: str) -> str:
    """Return a URDF with the paths of its visual meshes, without collision shapes."""
    root = fromstring(urdf)
    for link in root.iter("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(resolve_uri(mesh.get("filename", "")).resolve()))
    return tostring(root, encoding="unicode")
