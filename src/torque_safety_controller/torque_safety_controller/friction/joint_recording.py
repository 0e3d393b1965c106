# SPDX-License-Identifier: Apache-2.0
"""Recorded joint states, and their averages over short blocks, which models are fitted to.

Averages over a block from sample s to sample e need no derivative of a noisy velocity: the mean
acceleration is (v_e - v_s) / (t_e - t_s). The torque of sample k is the one that was applied until
then, as in ``joint_states``, so that the mean torque is that of samples s + 1 to e.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile, is_zipfile
from zlib import error as CompressionError

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

KEYS = ("t", "q", "v", "tau")

_PIECE = 0.1  # s; noise averages out over it
_MOVED = 0.05  # rad; range of a joint from which positions tell a velocity
_RATE_ERROR = 0.5  # of the motion, that filters and noise explain


class RecordingError(ArmSafetyError, ValueError):
    """A recording that cannot be read or used."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Joint states of N samples and n joints, as a robot reports them.

    Attributes:
        t: time, shape (N,), s, increasing.
        q: position, shape (N, n), rad.
        v: velocity, shape (N, n), rad/s.
        tau: torque of the motors, shape (N, n), N m.
        lost: number of further samples of which something is not known.

    Raises:
        RecordingError: shapes do not fit, a number is not finite, or time does not increase.
    """

    t: Array
    q: Array
    v: Array
    tau: Array
    lost: int = 0

    def __post_init__(self) -> None:
        samples, n = len(self.t), self.n
        if self.t.ndim != 1 or samples < 2:
            raise RecordingError(f"'t' must have shape (N,) with N > 1, has {self.t.shape}")
        for key in KEYS[1:]:
            value = getattr(self, key)
            if value.shape != (samples, n):
                raise RecordingError(f"'{key}' must have shape {samples, n}, has {value.shape}")
            if not np.isfinite(value).all():
                raise RecordingError(f"'{key}' has numbers that are not finite")
        if not (np.diff(self.t) > 0.0).all():
            late = int(np.argmin(np.diff(self.t) > 0.0))
            raise RecordingError(f"'t' does not increase after sample {late}")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.q.shape[1]


def load_recording(path: Path, joints: Sequence[str]) -> Recording:
    """Return a recording from a NumPy file of `t`, `q`, `v`, `tau` and perhaps `joints`.

    Samples with NaN, as of messages that were lost, are left out: they make a gap.

    Args:
        path: ``.npz``; the columns are in the order of its `joints`, or else of `joints`.
        joints: names of the joints wanted, in the order wanted; the file may have more.

    Raises:
        RecordingError: the file cannot be read, lacks an array or a joint, or `Recording` refuses;
            or velocities are not those of the positions: of other units, or other joints.
    """
    try:
        if path.is_file() and not is_zipfile(path):
            raise RecordingError("no .npz file, or one whose end is missing")
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key].astype(np.float64) for key in KEYS}
            names = [str(name) for name in file["joints"]] if "joints" in file else list(joints)
        for joint in joints:
            if joint not in names:
                raise RecordingError(f"joint '{joint}' is missing; it has {', '.join(names)}")
        for key in KEYS[1:]:
            if arrays[key].ndim != 2 or arrays[key].shape[1] != len(names):
                raise RecordingError(
                    f"'{key}' must have one column for each of {len(names)} joints, has shape "
                    f"{arrays[key].shape}"
                )
            arrays[key] = arrays[key][:, [names.index(joint) for joint in joints]]
        lost = _lost(arrays)
        recording = Recording(
            **{key: value[~lost] if lost.any() else value for key, value in arrays.items()},
            lost=int(lost.sum()),
        )
        _check_rates(recording, joints)
        return recording
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except KeyError as error:
        raise RecordingError(f"{path}: array missing: {error}") from error
    except (OSError, TypeError, ValueError, EOFError, BadZipFile, CompressionError) as error:
        raise RecordingError(f"{path}: no NumPy file of arrays of numbers ({error})") from error


def _lost(arrays: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Return which samples have NaN, shape (N,); none of them if that leaves nothing, or unequal.

    `Recording` says what is wrong then.
    """
    none = np.zeros(len(arrays["t"]), dtype=bool)
    if len({len(value) for value in arrays.values()}) > 1:
        return none
    unknown = [np.isnan(arrays[key]).any(axis=1) for key in KEYS[1:]]
    lost: NDArray[np.bool_] = np.logical_or.reduce(unknown)
    return none if lost.all() else lost


def _check_rates(recording: Recording, joints: Sequence[str]) -> None:
    """Compare positions with the integrals of velocities over pieces of `_PIECE`."""
    t, v, q = recording.t, recording.v, np.unwrap(recording.q, axis=0)  # drivers wrap angles
    h = np.diff(t)
    period = float(np.median(h))
    whole = (h < 1.5 * period)[:, None]  # nothing is known of gaps
    starts = np.arange(0, len(h), max(1, round(_PIECE / period)))
    moved = np.add.reduceat(np.where(whole, np.diff(q, axis=0), 0.0), starts)
    expected = np.add.reduceat(np.where(whole, 0.5 * h[:, None] * (v[1:] + v[:-1]), 0.0), starts)
    way = np.linalg.norm(moved, axis=0)
    off = np.linalg.norm(moved - expected, axis=0) / np.where(way > 0.0, way, 1.0)
    worst = int(np.argmax(np.where(np.ptp(q, axis=0) > _MOVED, off, 0.0)))
    if off[worst] > _RATE_ERROR and np.ptp(q[:, worst]) > _MOVED:
        raise RecordingError(
            f"'v' of {joints[worst]} differs by {off[worst]:.0%} from the rate of its 'q'; "
            "allowed: s, rad and rad/s of one joint"
        )


@dataclass(frozen=True, eq=False)
class Blocks:
    """Averages over B blocks of a recording.

    Attributes:
        t: middle, shape (B,), s.
        q, v, a, tau: means, shape (B, n).
        samples: velocities between the samples, on the straight line nearest to them, shape
            (B, m, n), rad/s: what is not linear in them is averaged after it has been evaluated.
        bend: mean square of what the samples are off it, as a deviation, shape (B, n), rad/s.
        noise: standard deviation of `v` that the sensors' noise makes, shape (n,), rad/s.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    tau: Array
    samples: Array
    bend: Array
    noise: Array


def make_blocks(recording: Recording, duration: float) -> Blocks:
    """Return the averages over blocks of about `duration`, s; those with a gap are left out.

    Raises:
        RecordingError: the recording is shorter than that.
    """
    t, q, v, tau = (getattr(recording, key) for key in KEYS)
    period = float(np.median(np.diff(t)))
    m = max(1, round(duration / period))
    count = (len(t) - 1) // m
    if count < 1:
        raise RecordingError(f"it is too short: {t[-1] - t[0]:.3g} s")
    s = m * np.arange(count)
    span = t[s + m] - t[s]
    s, span = s[span < 1.5 * m * period], span[span < 1.5 * m * period]
    index = s[:, None] + np.arange(m + 1)
    # Twice differenced, motion is gone and noise is sqrt(6) times larger.
    rest = np.abs(np.diff(v, 2, axis=0)) if len(t) > 2 else np.zeros((1, recording.n))
    mean = v[index].mean(axis=1)
    ramp = np.arange(m + 1) - 0.5 * m
    slope = np.einsum("k,bkj->bj", ramp, v[index]) / (ramp @ ramp)
    middle = 0.5 * (ramp[1:] + ramp[:-1])
    off = v[index] - mean[:, None] - ramp[:, None] * slope[:, None]
    return Blocks(
        t=0.5 * (t[s] + t[s + m]),
        q=q[index].mean(axis=1),
        v=mean,
        a=(v[s + m] - v[s]) / span[:, None],
        tau=tau[index[:, 1:]].mean(axis=1),
        samples=mean[:, None] + middle[:, None] * slope[:, None],
        bend=np.sqrt((off**2).mean(axis=1)),
        noise=np.median(rest, axis=0) / (0.6745 * np.sqrt(6.0 * (m + 1))),
    )
