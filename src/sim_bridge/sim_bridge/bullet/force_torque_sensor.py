"""What a force/torque sensor of a robot feels.

Newton and Euler for all that the sensor carries, in a physics step from (q, v) to v+: the
arm's force on it, weight, contacts and pushes make up its change of momentum,

    -w + sum I g + sum f = sum (I a + v x* I v),    a made of (v+ - v) / h,

so that w, what it does to the arm, follows from the motion, exactly as in the equations of motion
that PyBullet solves. How PyBullet carries the force through its joints does not matter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

import numpy as np
import pinocchio as pin

from sim_bridge.urdf.links import carried_links, links_beyond, scale_masses
from viability_bounds_pkg.robot_description import build_model, kinematic_order


class Push(NamedTuple):
    """A wrench on a link of the robot, in world axes."""

    link: str
    point: np.ndarray | None  # where the force acts, shape (3,), m; None: the link's origin
    force: Sequence[float]  # shape (3,), N
    torque: Sequence[float] = (0.0, 0.0, 0.0)  # shape (3,), N m


class ForceTorqueSensor:
    """A sensor that is a link of the robot: it feels what that link carries, but not itself.

    Args:
        urdf_text: the URDF.
        frame: the link; the sensor measures at its origin, in its axes.
        joints: names of the n joints that move.
        locked_positions: where other joints are locked, rad or m.
        mass_scales: factors for mass and inertia of links, by name.
        gravity: shape (3,), m/s^2.
        physics_dt: the physics step h, s.

    Attributes:
        wrench: force, N, and moment, N m, of what the sensor carries on it, shape (6,).

    Raises:
        RobotDescriptionError: there is no such link, or it carries nothing.
    """

    def __init__(
        self,
        urdf_text: str,
        frame: str,
        joints: Sequence[str],
        locked_positions: Mapping[str, float] | None,
        mass_scales: Mapping[str, float] | None,
        gravity: Sequence[float],
        physics_dt: float,
    ) -> None:
        root = fromstring(urdf_text)
        scale_masses(root, mass_scales or {})
        locked = dict(locked_positions or {})
        self._beyond = {x for link in carried_links(root, frame) for x in links_beyond(root, link)}
        # Joints of the sensor become joints of the model, whose forces it tells.
        mounts = [joint for joint in root.findall("joint") if _parent(joint) == frame]
        names = {joint.get("name", "") for joint in mounts}
        for joint in mounts:
            if joint.get("type") == "fixed":
                joint.set("type", "revolute")
                SubElement(joint, "limit", effort="0", velocity="0")
        text = tostring(root, encoding="unicode")
        order = kinematic_order(text, [*joints, *(names - set(joints))])
        still = {name: locked.pop(name, 0.0) for name in names - set(joints)}
        self._model = model = build_model(text, order, locked)
        model.gravity.linear = np.array(gravity)
        self._data = model.createData()
        self._frame = model.getFrameId(frame, pin.FrameType.BODY)
        self._mounts = [model.getJointId(name) for name in names]
        self._q = np.array([still.get(name, 0.0) for name in order])
        self._v, self._a = np.zeros((2, len(order)))
        self._moving = [order.index(name) for name in joints]
        self._dt = physics_dt
        self.wrench = np.zeros(6)

    def update(
        self, q: np.ndarray, v: np.ndarray, v_next: np.ndarray, pushes: Iterable[Push]
    ) -> None:
        """Feel a physics step.

        Args:
            q: PyBullet's own positions at its beginning, shape (n,), rad.
            v: velocities at its beginning, shape (n,), rad/s.
            v_next: velocities at its end, shape (n,), rad/s.
            pushes: all that pushed on the robot in it.
        """
        model, data = self._model, self._data
        self._q[self._moving], self._v[self._moving] = q, v
        self._a[self._moving] = (v_next - v) / self._dt
        pin.rnea(model, data, self._q, self._v, self._a)
        pin.updateGlobalPlacements(model, data)
        sensor = pin.updateFramePlacement(model, data, self._frame)
        felt = pin.Force.Zero()
        for mount in self._mounts:
            felt -= sensor.actInv(data.oMi[mount].act(data.f[mount]))
        for push in pushes:
            if push.link in self._beyond:
                point = push.point
                if point is None:
                    link = model.getFrameId(push.link, pin.FrameType.BODY)
                    point = pin.updateFramePlacement(model, data, link).translation
                force = np.array(push.force)
                felt += sensor.actInv(pin.Force(force, np.cross(point, force) + push.torque))
        self.wrench = felt.vector


def _parent(joint: Element) -> str:
    return joint.find("parent").get("link", "")
