# SPDX-License-Identifier: Apache-2.0
"""Identification of joint friction from a recorded motion, also with wrong inertias.

The motor torque minus the torque of the model is

    tau - rnea(q, v, a) = sign(v) (F_c + (F_s - F_c) exp(-(v / v_s)^2)) + d v + Y(q, v, a) x + b,

the sum of friction, of the effect of errors x of masses, centres of mass, inertias and rotors, in
which rigid-body dynamics are linear, and of a bias b. The same motion backward has the same Y and
the opposite friction, so that the two can be separated where a joint passes the same positions in
both directions. x and b are eliminated, for each joint alone, and friction is fitted to the rest
by least squares with Huber's weights; v_s is found by a search (variable projection,
[Golub1973]). Standard errors come from the scatter between pieces of the recording, because
neighbouring residuals are correlated. `docs/guides/tuning.md` tells how to use it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from torque_safety_controller.friction.joint_recording import (
    Blocks,
    Recording,
    RecordingError,
    make_blocks,
)
from torque_safety_controller.friction.regression import JointRegression
from torque_safety_controller.friction.settings import (
    COEFFICIENTS,
    DEFAULT_STRIBECK_VELOCITY,
    FrictionModel,
)

Array = NDArray[np.float64]

BLOCK = 0.02
"""Duration of the blocks that are averaged over, s."""

STANDING = 1e-3
"""Speed, rad/s, below which a joint may stand still and is not used; or four times the noise."""

SURE = 3.0
"""A coefficient is accepted if it is above zero by this many standard errors."""

LEAST_LEFT = 0.05
"""Least share of the friction that must remain when errors of the model are eliminated."""

_BEND = 0.2  # deviation from steady acceleration, of the speed; with more it stuck or slipped
_FEWEST = 20  # blocks in each direction
_FEWEST_SLOW = 8  # blocks below half of v_s, without which stiction is a guess
_BLOCKS_PER_UNKNOWN = 1.5
_ROUNDS = 3
_CANDIDATES = np.geomspace(1.0, 300.0, 48)  # v_s in standing speeds


@dataclass
class JointFit:
    """Identified friction of one joint.

    Attributes:
        coulomb, static, viscous, stribeck_velocity: as in `FrictionModel`; zero where nothing
            was found; `static` is then `coulomb`.
        errors: their standard errors in this order, shape (4,); NaN where nothing was found.
        residual: standard deviation of the residual, N m.
        blocks: how many were used.
        speeds: least and greatest among them, rad/s.
        notes: what could not be identified, and why.
    """

    coulomb: float = 0.0
    static: float = 0.0
    viscous: float = 0.0
    stribeck_velocity: float = DEFAULT_STRIBECK_VELOCITY
    errors: Array = field(default_factory=lambda: np.full(4, np.nan))
    residual: float = float("nan")
    blocks: int = 0
    speeds: tuple[float, float] = (0.0, 0.0)
    notes: list[str] = field(default_factory=list)


def identify(model: pin.Model, recording: Recording) -> Iterator[JointFit]:
    """Identify the friction of one joint after the other.

    Args:
        model: nominal, n joints, rotors as armature.
        recording: of these joints in the model's order.

    Raises:
        RecordingError: the recording has another number of joints, or is too short.
    """
    if recording.n != model.nv:
        raise RecordingError(f"it has {recording.n} joints, the robot {model.nv}")
    blocks = make_blocks(recording, BLOCK)
    beyond, errors = model_errors(model, blocks)
    for joint in range(model.nv):
        yield fit_joint(blocks, joint, beyond[:, joint], errors[:, joint])


def friction_model(fits: Sequence[JointFit]) -> FrictionModel:
    """Return the friction model of all joints."""
    values = (np.array([getattr(fit, name) for fit in fits]) for name in COEFFICIENTS)
    return FrictionModel(*values)


def model_errors(model: pin.Model, blocks: Blocks) -> tuple[Array, Array]:
    """Return the torque beyond the model's, and the regressor of errors of the model.

    Returns:
        Shape (B, n), N m, and the Y of each joint with its rotor and a bias, (B, n, 10 n + 2).
    """
    data = model.createData()
    count, n = blocks.q.shape
    beyond = np.empty((count, n))
    errors = np.empty((count, n, 10 * n + 2))
    for k, (q, v, a) in enumerate(zip(blocks.q, blocks.v, blocks.a, strict=True)):
        beyond[k] = blocks.tau[k] - pin.rnea(model, data, q, v, a)
        errors[k, :, :-2] = pin.computeJointTorqueRegressor(model, data, q, v, a)
        errors[k, :, -2] = a
    errors[:, :, -1] = 1.0
    return beyond, errors


def fit_joint(blocks: Blocks, joint: int, beyond: Array, errors: Array) -> JointFit:
    """Return the friction of one joint.

    Args:
        blocks: of the recording.
        joint: its number.
        beyond: torque beyond the model's, shape (B,), N m.
        errors: columns that errors of the model explain, shape (B, k).
    """
    fit = JointFit()
    speed, noise = blocks.v[:, joint], blocks.noise[joint]
    standing = max(STANDING, 4.0 * noise)
    direction = np.sign(speed)
    slowest = (blocks.samples[:, :, joint] * direction[:, None]).min(axis=1)
    samples = blocks.samples.shape[1] + 1
    steady = blocks.bend[:, joint] < _BEND * np.abs(speed) + 2.0 * noise * np.sqrt(samples)
    used = (np.abs(speed) > standing) & (slowest > 0.5 * standing) & steady
    fit.blocks = int(used.sum())
    if fit.blocks:
        fit.speeds = float(np.abs(speed[used]).min()), float(np.abs(speed[used]).max())
    one_way = min(int((direction[used] == side).sum()) for side in (1.0, -1.0))
    if one_way < _FEWEST:
        fit.notes.append("nothing found: it did not move both ways for long enough")
        return fit
    data = JointRegression(
        blocks.samples[used][:, :, joint],
        direction[used],
        blocks.t[used],
        beyond[used],
        errors[used],
    )
    if fit.blocks < _BLOCKS_PER_UNKNOWN * data.unknowns:
        fit.notes.append(
            f"nothing found: {fit.blocks} blocks of {BLOCK:g} s are too few for {data.unknowns} "
            "unknowns"
        )
        return fit
    if data.left(direction[used]) < LEAST_LEFT:
        fit.notes.append(
            "nothing found: from this motion friction cannot be told from errors of the model; "
            "pass the same positions both ways"
        )
        return fit
    _fill(fit, data, standing)
    return fit


def _fill(fit: JointFit, data: JointRegression, standing: float) -> None:
    """Fit the coefficients; drop those that are not significant."""
    candidates = standing * _CANDIDATES
    candidates = candidates[candidates < max(fit.speeds[1], 2.0 * standing)]
    kept = [0, 1, 2]
    for _ in range(_ROUNDS):
        v_s = _best(data, candidates, kept)
        for _ in range(_ROUNDS):
            data.reweight(v_s, data.solve(v_s, kept)[1])
    names = ("Coulomb friction", "stiction beyond Coulomb friction", "viscous friction")
    while kept:
        v_s = _best(data, candidates, kept)
        x = data.solve(v_s, kept)[1]
        errors, fit.residual = data.standard_errors(v_s, x, kept)
        # NaN and zero are not sure.
        unsure = [k for k in kept if not x[k] > SURE * errors[k]]
        if not unsure:
            break
        worst = min(unsure, key=lambda k: x[k] / errors[k] if errors[k] > 0.0 else 0.0)
        fit.notes.append(
            f"{names[worst]} not told: {x[worst]:.2g} with a standard error of {errors[worst]:.2g}"
        )
        kept.remove(worst)
    else:
        return
    fit.coulomb, fit.static, fit.viscous = float(x[0]), float(x[0] + x[1]), float(x[2])
    fit.errors = errors[[0, 4, 2, 3]]
    if 1 in kept and data.slower(0.5 * v_s) >= _FEWEST_SLOW:
        fit.stribeck_velocity = v_s
    elif 1 in kept:
        fit.notes.append(f"stiction not told: the speed was hardly ever below {0.5 * v_s:.2g}")
        fit.static, fit.errors[1], fit.errors[3] = fit.coulomb, fit.errors[0], np.nan


def _best(data: JointRegression, candidates: Array, kept: Sequence[int]) -> float:
    """Return the v_s that fits best: of the candidates, then between the best one's neighbours."""
    costs = [data.solve(v_s, kept)[0] for v_s in candidates] if 1 in kept else [0.0]
    k = int(np.argmin(costs))
    if k == 0:
        return float(candidates[0])
    ends = np.log(candidates[[k - 1, min(k + 1, len(candidates) - 1)]])
    found = minimize_scalar(
        lambda x: data.solve(np.exp(x), kept)[0],
        bounds=ends,
        method="bounded",
        options={"xatol": 1e-3},
    )
    return float(np.exp(found.x))
