# SPDX-License-Identifier: Apache-2.0
"""The page in the browser: the arm in 3D, its joints, and what its user asks for."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from sim_bridge.viewer.joint_pictures import LEGEND, JointPictures, JointValues, colour, usage
from sim_bridge.viewer.shapes import VisualShape
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import frame_id

Array = NDArray[np.float64]

_BASE_COLOUR = (150, 150, 155)
_PUSH_STIFFNESS = 200.0
"""Force of a push by how far its handle is dragged, N/m."""


class GoalAsked(NamedTuple):
    """The user moved the goal of the hand."""

    pose: pin.SE3
    """In the base frame."""


class PushAsked(NamedTuple):
    """The user pushes a link, or ends it."""

    link: str
    force: Array
    """Shape (3,), N in world axes; zeros end the push."""


class DrivingAsked(NamedTuple):
    """The user switched "drive the arm" on or off."""

    drive: bool


Request = GoalAsked | PushAsked | DrivingAsked


class Page:
    """Serves the page, shows pictures, and queues what its user asks for.

    Args:
        address: host and port to serve on; the next free port if it is taken.
        model: of the arm.
        shapes: visual geometry of the arm.
        limits: of the n joints.
        tau_max: torque limits, shape (n,), N m.
        frames: names of the base and of the hand.
        units: of the joints' positions.

    Attributes:
        address: of the page.
    """

    def __init__(
        self,
        address: tuple[str, int],
        model: pin.Model,
        shapes: Sequence[VisualShape],
        limits: JointLimits,
        tau_max: Array,
        frames: tuple[str, str],
        units: Sequence[str],
    ) -> None:
        self._model, self._data = model, model.createData()
        self._limits, self._tau_max = limits, tau_max
        # Of the last picture, whole at any time: the threads of the server read them, too.
        self._base_pose, self._push_origin = pin.SE3.Identity(), np.zeros(3)
        self._base, self._hand = (frame_id(model, name) for name in frames)
        self._requests: SimpleQueue[Request] = SimpleQueue()
        self._pictures = JointPictures(limits.names, limits, tau_max, units)
        self._driving = self._dragging = self._pushing = self._camera_placed = False
        with redirect_stdout(io.StringIO()):  # its banner, even if not verbose
            self._server = viser.ViserServer(*address, label="arm", verbose=False)
        self._server.on_client_disconnect(self._on_leave)
        self.address = f"http://{address[0]}:{self._server.get_port()}"
        self._make_scene(shapes)
        self._make_panel()

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def requests(self) -> list[Request]:
        """Return what was asked for since the last call; of goals and pushes the newest only."""
        kept: dict[Any, Request] = {}
        while True:
            try:
                request = self._requests.get_nowait()
            except Empty:
                return list(kept.values())
            subject = request.link if isinstance(request, PushAsked) else type(request)
            kept.pop(subject, None)
            kept[subject] = request

    def show(self, joints: JointValues, goal: pin.SE3 | None, text: str) -> None:
        """Update the page; nothing to do while nobody has it open.

        Args:
            joints: their values.
            goal: pose goal in the base frame; None if there is none.
            text: state in words, Markdown.
        """
        if self._camera_placed and not self._server.get_clients():
            return
        pin.framesForwardKinematics(self._model, self._data, joints.q)
        if not self._camera_placed:
            self._place_camera()
        self._base_pose = self._data.oMf[self._base].copy()
        if self._link.value:
            link = self._data.oMf[frame_id(self._model, self._link.value)]
            self._push_origin = link.translation.copy()
        shares = usage(joints, self._limits, self._tau_max)
        with self._server.atomic():
            for index, (frame, meshes) in self._bodies.items():
                _place(frame, self._data.oMi[index])
                tone = colour(float(shares[index - 1]))
                for mesh in meshes:
                    if tuple(mesh.color) != tone:
                        mesh.color = tone
            self._show_goal(goal)
            self._show_handle()
            self._joint_pictures.content = self._pictures.draw(joints)
            self.show_text(text)

    def show_text(self, text: str) -> None:
        """Show text alone, Markdown."""
        if self._text.content != text:
            self._text.content = text

    # The scene

    def _make_scene(self, shapes: Sequence[VisualShape]) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.add_grid("/floor", width=3.0, height=3.0, cell_size=0.1, section_size=0.5)
        self._bodies: dict[int, tuple[viser.FrameHandle, list[viser.MeshHandle]]] = {}
        for number, shape in enumerate(shapes):
            if not len(shape.triangles):
                continue
            at, name = shape.joint, f"/arm/{self._model.names[shape.joint]}"
            if at and at not in self._bodies:
                self._bodies[at] = scene.add_frame(name, show_axes=False), []
            mesh = scene.add_mesh_simple(
                f"{name}/{number}",
                shape.vertices,
                shape.triangles,
                color=_BASE_COLOUR if at == 0 else colour(0.0),
                side="double",
                # Half of the time of a picture where there is no graphics card.
                cast_shadow=False,
                receive_shadow=False,
            )
            if at:
                self._bodies[at][1].append(mesh)
        self._goal = scene.add_transform_controls("/goal", scale=0.25, visible=False)
        self._handle = scene.add_transform_controls(
            "/push", scale=0.18, disable_rotations=True, visible=False
        )
        scene.add_label("/goal/label", "goal", anchor="bottom-center")
        scene.add_label("/push/label", "push", anchor="bottom-center")
        self._goal.on_update(self._on_goal)
        self._handle.on_update(self._on_push)

    def _place_camera(self) -> None:
        """Place the camera so that it sees all of the arm."""
        self._camera_placed = True
        places = (self._data.oMf[self._hand], *list(self._data.oMi)[1:])
        points = np.array([place.translation for place in places])
        low, high = points.min(axis=0), points.max(axis=0)
        middle, size = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), 0.5)
        camera = self._server.initial_camera
        camera.position = tuple(middle + 1.3 * size * np.array([0.9, -1.1, 0.5]))
        camera.look_at = tuple(middle)

    def _show_goal(self, goal: pin.SE3 | None) -> None:
        """Move the goal's handle to the goal, or to the hand where there is none."""
        self._goal.visible = self._driving or goal is not None
        if not self._dragging:
            hand = self._data.oMf[self._hand]
            _place(self._goal, hand if goal is None else self._base_pose * goal)

    def _show_handle(self) -> None:
        """Move the handle of pushes to its link, unless the user drags it."""
        self._handle.visible = self._driving and bool(self._link.value)
        if not self._pushing:
            self._handle.position = np.array(self._push_origin)

    # The panel

    def _make_panel(self) -> None:
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()  # beside the arm, not over it
        self._text = gui.add_markdown("")
        self._drive = gui.add_checkbox(
            "drive the arm",
            initial_value=False,
            hint="goals and pushes are sent while this is on",
        )
        self._drive.on_update(self._on_drive)
        links = [
            frame.name
            for frame in self._model.frames
            if frame.type == pin.FrameType.BODY and frame.parentJoint > 0
        ] or [""]
        self._link = gui.add_dropdown("push link", links, initial_value=links[len(links) // 2])
        gui.add_html(LEGEND)
        self._joint_pictures = gui.add_html("")

    # What the user does; in threads of the server

    def _on_drive(self, _: Any) -> None:
        self._driving = self._drive.value
        self._requests.put(DrivingAsked(self._driving))

    def _on_leave(self, _: Any) -> None:
        """End driving when nobody has the page open any more."""
        if not self._server.get_clients():
            self._drive.value = False  # type: ignore[misc]  # its callback follows

    def _on_goal(self, event: viser.TransformControlsEvent) -> None:
        self._dragging = event.phase != "end"
        if self._driving:
            world = pin.SE3(pin.Quaternion(*self._goal.wxyz), np.array(self._goal.position))
            self._requests.put(GoalAsked(self._base_pose.actInv(world)))

    def _on_push(self, event: viser.TransformControlsEvent) -> None:
        self._pushing = event.phase != "end"
        if self._driving and self._link.value:
            drag = np.array(self._handle.position) - self._push_origin
            force = _PUSH_STIFFNESS * drag if self._pushing else np.zeros(3)
            self._requests.put(PushAsked(self._link.value, force))


def _place(node: viser.SceneNodeHandle, pose: pin.SE3) -> None:
    x, y, z, w = pin.Quaternion(pose.rotation).coeffs()
    node.wxyz = w, x, y, z
    node.position = np.array(pose.translation)
