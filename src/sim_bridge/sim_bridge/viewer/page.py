# SPDX-License-Identifier: Apache-2.0
"""The page in the browser: what it shows, and what its user asks for."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from sim_bridge.viewer.joint_pictures import JointPictures, JointValues, colour, usage
from sim_bridge.viewer.shapes import VisualShape
from viability_bounds_pkg.joint_limits import JointLimits

Array = NDArray[np.float64]

METHODS = "exact", "naive"
COMPLIANCE = {
    "none": "no integral action",
    "joints": "stiff in all joints",
    "task": "stiff at the hand",
}
"""Values of the controller's ``integral_action``, and what they mean."""
UNKNOWN = "unknown"

_BASE = (150, 150, 155)
_FORCE, _FELT = (220, 60, 40), (40, 90, 200)
_FORCE_LENGTH = 0.01
"""Of an arrow, m/N."""


class GoalAsked(NamedTuple):
    """The user moved the goal of the hand."""

    pose: pin.SE3
    """In the base frame."""


class JointsAsked(NamedTuple):
    """The user moved the slider of a joint."""

    q: Array
    """Positions of all joints, shape (n,), rad."""


class PushAsked(NamedTuple):
    """The user pushes a link, or ends it."""

    link: str
    force: Array
    """Shape (3,), N in world axes; zeros end the push."""


class SettingAsked(NamedTuple):
    """The user chose the value of another node's parameter."""

    node: str
    name: str
    value: Any


class DrivingAsked(NamedTuple):
    """The user begins to drive the arm, or leaves it to others."""

    begin: bool


Request = GoalAsked | JointsAsked | PushAsked | SettingAsked | DrivingAsked


class Picture(NamedTuple):
    """All that is shown at one time."""

    joints: JointValues
    goal: pin.SE3 | None
    """Pose goal in the base frame; None if there is none."""
    pushes: Mapping[str, Array]
    """Forces on links, N in world axes, by link."""
    felt: Array | None
    """Force that the wrist's sensor measures, N in its axes; None if there is none."""
    state: str
    """In words, Markdown."""
    settings: Mapping[tuple[str, str], Any]
    """Values of parameters that can be chosen, by node and name; only those known."""


class Page:
    """Serves the page, shows pictures, and keeps what its user asks for until it is fetched.

    Args:
        host: address to serve on.
        port: to serve on; the next free one if it is taken.
        model: of the arm.
        shapes: what of it is to be seen.
        limits: of the n joints.
        tau_max: torque limits, shape (n,), N m.
        frames: names of the base, of the hand and of the force sensor; the latter may be empty.

    Attributes:
        address: of the page.
    """

    def __init__(
        self,
        host: str,
        port: int,
        model: pin.Model,
        shapes: Sequence[VisualShape],
        limits: JointLimits,
        tau_max: Array,
        frames: tuple[str, str, str],
    ) -> None:
        self._model, self._data = model, model.createData()
        self._limits, self._tau_max = limits, tau_max
        # Of the last picture, whole at any time: the threads of the server read them, too.
        self._base_pose, self._origin = pin.SE3.Identity(), np.zeros(3)
        self._base, self._hand = (model.getFrameId(name) for name in frames[:2])
        self._sensor = model.getFrameId(frames[2]) if frames[2] else None
        self._requests: SimpleQueue[Request] = SimpleQueue()
        self._pictures = JointPictures(limits.names, limits, tau_max)
        self._driving = self._dragging = self._pushing = self._framed = False
        with redirect_stdout(io.StringIO()):  # its banner, even if not verbose
            self._server = viser.ViserServer(host=host, port=port, label="arm", verbose=False)
        self.address = f"http://{host}:{self._server.get_port()}"
        self._make_scene(shapes)
        self._make_panel()

    def close(self) -> None:
        """End the page."""
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
            subject: Any = type(request)
            if isinstance(request, PushAsked):
                subject = request.link
            elif isinstance(request, SettingAsked):
                subject = request.node, request.name
            kept.pop(subject, None)
            kept[subject] = request

    def show(self, picture: Picture) -> None:
        """Show it to all who look."""
        if self._framed and not self._server.get_clients():
            return
        pin.framesForwardKinematics(self._model, self._data, picture.joints.q)
        if not self._framed:
            self._frame_arm()
        self._base_pose = self._data.oMf[self._base].copy()
        if self._link.value:
            self._origin = self._frame(self._link.value).translation.copy()
        shares = usage(picture.joints, self._limits, self._tau_max)
        with self._server.atomic():
            for index, (frame, meshes) in self._bodies.items():
                _place(frame, self._data.oMi[index])
                tone = colour(float(shares[index - 1]))
                for mesh in meshes:
                    if tuple(mesh.color) != tone:
                        mesh.color = tone
            self._show_goal(picture.goal)
            self._show_forces(picture)
            self._joint_pictures.content = self._pictures.draw(picture.joints)
            self.say(picture.state)
            self._show_settings(picture)

    def say(self, text: str) -> None:
        """Show words alone, Markdown."""
        if self._words.content != text:
            self._words.content = text

    # The scene

    def _make_scene(self, shapes: Sequence[VisualShape]) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.add_grid("/floor", width=3.0, height=3.0, cell_size=0.1, section_size=0.5)
        frames: dict[int, viser.FrameHandle] = {}
        meshes: dict[int, list[viser.MeshHandle]] = {}
        for number, shape in enumerate(shapes):
            if not len(shape.triangles):
                continue
            at = shape.joint
            if at not in frames:
                frames[at] = scene.add_frame(f"/arm/{self._model.names[at]}", show_axes=False)
            meshes.setdefault(at, []).append(
                scene.add_mesh_simple(
                    f"/arm/{self._model.names[at]}/{number}",
                    shape.vertices,
                    shape.triangles,
                    color=_BASE if at == 0 else colour(0.0),
                    side="double",
                    # Half of the time of a picture where there is no graphics card.
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )
        self._bodies = {at: (frames[at], meshes[at]) for at in frames if at > 0}
        self._arrows: dict[str, viser.ArrowsHandle] = {}
        self._goal = scene.add_transform_controls("/goal", scale=0.25, visible=False)
        self._handle = scene.add_transform_controls(
            "/push", scale=0.18, disable_rotations=True, visible=False
        )
        self._goal.on_update(self._on_goal)
        self._handle.on_update(self._on_push)

    def _frame_arm(self) -> None:
        """Put the camera where it sees all of the arm, beside the panel."""
        self._framed = True
        places = (self._data.oMf[self._hand], *list(self._data.oMi)[1:])
        points = np.array([place.translation for place in places])
        low, high = points.min(axis=0), points.max(axis=0)
        middle, size = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), 0.5)
        away = np.array([0.9, -1.1, 0.5])
        self._server.initial_camera.position = tuple(middle + 1.3 * size * away)
        # Aside, as the panel covers the right of the page.
        self._server.initial_camera.look_at = tuple(
            middle + 0.2 * size * np.array([1.0, 0.8, 0.0])
        )

    def _show_goal(self, goal: pin.SE3 | None) -> None:
        """Let the goal's handle be where the goal is; without one, at the hand."""
        self._goal.visible = self._driving or goal is not None
        if self._dragging:
            return
        hand = self._data.oMf[self._hand]
        _place(self._goal, hand if goal is None else self._base_pose * goal)

    def _show_forces(self, picture: Picture) -> None:
        self._handle.visible = self._driving and bool(self._link.value)
        if not self._pushing:
            self._handle.position = np.array(self._origin)
        forces = {
            f"push {link}": (
                self._data.oMf[self._model.getFrameId(link)].translation,
                force,
                _FORCE,
            )
            for link, force in picture.pushes.items()
            if self._model.existFrame(link)
        }
        if picture.felt is not None and self._sensor is not None:
            sensor = self._data.oMf[self._sensor]
            forces["felt"] = sensor.translation, sensor.rotation @ picture.felt, _FELT
        for name in self._arrows.keys() - forces.keys():
            self._arrows.pop(name).remove()
        for name, (start, force, tone) in forces.items():
            ends = np.array([[start, start + _FORCE_LENGTH * force]], dtype=np.float32)
            if name in self._arrows:
                self._arrows[name].points = ends
                continue
            self._arrows[name] = self._server.scene.add_arrows(
                f"/forces/{name}",
                ends,
                colors=tone,
                shaft_radius=0.008,
                head_radius=0.02,
                head_length=0.04,
            )

    # The panel

    def _make_panel(self) -> None:
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self._words = gui.add_markdown("")
        self._drive = gui.add_checkbox(
            "drive the arm",
            initial_value=False,
            hint="goals, joints and pushes are sent while this is on",
        )
        self._drive.on_update(self._on_drive)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Joints"):
            self._joint_pictures = gui.add_html("")
        with tabs.add_tab("Drive"):
            links = [
                frame.name
                for frame in self._model.frames
                if frame.type == pin.FrameType.BODY and frame.parentJoint > 0
            ] or [""]
            self._link = gui.add_dropdown("push link", links, initial_value=links[len(links) // 2])
            self._stiffness = gui.add_slider("push, N per metre of drag", 20.0, 500.0, 10.0, 200.0)
            self._sliders = [self._add_slider(k) for k in range(len(self._limits))]
        with tabs.add_tab("Settings"):
            self._choices: dict[tuple[str, str], Any] = {
                ("bounds_node", "method"): gui.add_dropdown("bounds", (UNKNOWN, *METHODS)),
                ("controller_node", "safety_filter"): gui.add_dropdown(
                    "safety filter", (UNKNOWN, "True", "False")
                ),
                ("controller_node", "integral_action"): gui.add_dropdown(
                    "integral action", (UNKNOWN, *COMPLIANCE.values())
                ),
            }
            for key, choice in self._choices.items():
                choice.on_update(self._setting_asked(key, choice))
            gui.add_markdown(
                "*Stiff at the hand* is null-space compliance: the rest of the arm yields. With "
                "*naive* bounds and no safety filter limits are passed."
            )

    def _add_slider(self, k: int) -> Any:
        low, high = float(self._limits.q_min[k]), float(self._limits.q_max[k])
        if not (np.isfinite(low) and np.isfinite(high)):
            low, high = -2.0 * np.pi, 2.0 * np.pi
        low, high = round(low, 3), round(high, 3)
        slider = self._server.gui.add_slider(
            self._limits.names[k], min=low, max=high, step=0.001, initial_value=0.5 * (low + high)
        )
        slider.on_update(self._on_slider)
        return slider

    def _show_settings(self, picture: Picture) -> None:
        for key, choice in self._choices.items():
            value = str(picture.settings.get(key, UNKNOWN))
            value = COMPLIANCE.get(value, value)
            if value not in choice.options:
                choice.options = (*choice.options, value)
            if choice.value != value:
                choice.value = value
        if not self._driving:
            for slider, q in zip(self._sliders, picture.joints.q, strict=True):
                slider.value = round(float(np.clip(q, slider.min, slider.max)), 3)

    # What the user does; in threads of the server

    def _on_drive(self, _: Any) -> None:
        self._driving = self._drive.value
        self._requests.put(DrivingAsked(self._driving))

    def _on_goal(self, event: viser.TransformControlsEvent) -> None:
        self._dragging = event.phase != "end"
        if self._driving:
            world = pin.SE3(pin.Quaternion(*self._goal.wxyz), np.array(self._goal.position))
            self._requests.put(GoalAsked(self._base_pose.actInv(world)))

    def _on_push(self, event: viser.TransformControlsEvent) -> None:
        self._pushing = event.phase != "end"
        if self._driving and self._link.value:
            pull = np.array(self._handle.position) - self._origin
            force = float(self._stiffness.value) * pull if self._pushing else np.zeros(3)
            self._requests.put(PushAsked(self._link.value, force))

    def _on_slider(self, event: viser.GuiEvent) -> None:
        # Without a client the page itself moved it.
        if self._driving and event.client is not None:
            q = np.array([float(slider.value) for slider in self._sliders])
            self._requests.put(JointsAsked(q))

    def _setting_asked(self, key: tuple[str, str], choice: Any) -> Callable[[Any], None]:
        def ask(event: viser.GuiEvent) -> None:
            if event.client is None or choice.value == UNKNOWN:
                return
            value: Any = choice.value
            value = {"True": True, "False": False}.get(value, value)
            value = {words: name for name, words in COMPLIANCE.items()}.get(value, value)
            self._requests.put(SettingAsked(*key, value))

        return ask

    def _frame(self, name: str) -> pin.SE3:
        return self._data.oMf[self._model.getFrameId(name)]


def _place(node: viser.SceneNodeHandle, pose: pin.SE3) -> None:
    x, y, z, w = pin.Quaternion(pose.rotation).coeffs()
    node.wxyz = w, x, y, z
    node.position = np.array(pose.translation)
