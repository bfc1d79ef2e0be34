"""Payload session: mass and centre of gravity of the payload, and the bias of the flange sensor.

At rest the sensor reads the payload's weight plus a constant bias. Only the weight turns with the
flange. The reading is linear in mass, mass times centre of gravity, and bias: a few orientations
determine all ten numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.effects import CATALOGUE, Site, Term, acting, correcting
from gapbridge.core.effects.effect import WRENCH_AXES as AXES
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.estimation.robust import robust_fit
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of
from gapbridge.core.notes import Note, Reason

(BIAS,) = correcting("sensor zero")
NAMES = ("payload_mass", *(f"payload_cog_{k}" for k in "xyz"), *(f"{BIAS}_{k}" for k in AXES))
UNITS = ("kg", "m", "m", "m", "N", "N", "N", "Nm", "Nm", "Nm")
MIN_MASS_SIGMAS = 3.0  # below it the centre of gravity is undetermined
MIN_READINGS = 3
MAX_NOISE = (10.0, 1.0)  # N, Nm, 1 sigma about load and bias: no sensor at rest has more
MIN_CHANGE = (0.5, 0.05)  # N, Nm from pose to pose, that no axis of a sensor overlooks
NOISE_SHARE = 0.1  # the same of the readings' change from pose to pose, for heavy loads


@dataclass(frozen=True)
class PayloadCalibration:
    """Result of a payload session."""

    mass: float  # kg, of everything beyond the sensor
    cog: Array  # (3,) m, flange axes
    bias: Array  # (6,) N, Nm: what the sensor reads with nothing on it, flange axes
    estimates: tuple[Estimate, ...]  # in the order of NAMES
    noise: tuple[float, float]  # N and Nm, 1 sigma of one axis of one reading
    residual: Array  # (N, 6) reading minus prediction
    outliers: NDArray[np.int64]  # readings down-weighted as outliers
    notes: tuple[Note, ...]

    def applied(self, model: Model) -> Model:
        """Return the model with this payload and bias, instead of its own.

        Where nothing weighs, the payload is none: the estimate may be just below 0 kg.
        """
        mass = 0.0 if Note(Reason.NOTHING_WEIGHS) in self.notes else self.mass
        replaced = (*correcting("payload"), BIAS)
        kept = tuple(t for t in model.terms if t.effect not in replaced)
        bias = Term(BIAS, Site(), tuple(float(v) for v in self.bias))
        return replace(model, payload_mass=mass, payload_cog=self.cog.copy(), terms=(*kept, bias))


def weight_columns(model: Model, q: Array) -> Array:
    """Return d reading / d (mass, mass x cog, bias) as (N, 6, 10), at rest at ``q`` (N, n).

    At the model's deflected flange; misalignment and gain of the sensor in the model are applied.
    """
    poses = model.predict(q)
    chain = model.chain()  # its gravity is the true one, turned by the model's effects
    flange_rotation = poses.rotation @ chain.tool_rotation.T
    down = np.swapaxes(flange_rotation, 1, 2) @ chain.gravity
    columns = np.zeros((len(q), 6, 10))
    columns[:, :3, 0] = down
    for k in range(3):
        columns[:, 3:, 1 + k] = np.cross(np.eye(3)[k], down)
    scaling = [t for t in model.terms if CATALOGUE[t.effect].scales_reading]
    motion = motion_of(Log("readings", {"actual_q": q}, model.arm.n))
    for k in range(4):
        for term in acting(scaling, "wrench"):
            columns[:, :, k] = CATALOGUE[term.effect].sense(
                term, model.arm, columns[:, :, k], motion
            )
    columns[:, :, 4:] = np.eye(6)
    return columns


def calibrate_payload(model: Model, q: Array, wrench: Array) -> PayloadCalibration:
    """Return mass, centre of gravity and sensor bias from readings at rest.

    ``q`` (N, n) rad, ``wrench`` (N, 6): ``ft_raw_wrench`` of docs/conventions.md, averaged at each
    pose. Outliers are down-weighted and listed. Raises InputError where the readings do not
    fit together, ExcitationError where the orientations do not separate load from bias.
    """
    q, wrench = np.asarray(q, dtype=float), np.asarray(wrench, dtype=float)
    _check_shapes(model, q, wrench)
    columns = weight_columns(model, q)
    _require_rotation(columns, len(q))
    flat, value = columns.reshape(-1, 10), wrench.reshape(-1)
    unit = np.tile(np.repeat([0, 1], 3), len(q))  # separate noise of forces and torques
    fit = robust_fit(flat, value, unit, row=np.repeat(np.arange(len(q)), 6))
    _require_live(wrench, (flat @ fit.values).reshape(-1, 6))
    _require_consistent(wrench, fit.noise)
    covariance, cog = _in_terms_of_cog(fit.values, fit.covariance)
    mass = float(fit.values[0])
    values = np.concatenate([[mass], cog, fit.values[4:]])
    std = np.sqrt(np.diag(covariance))
    estimates = tuple(
        Estimate(name, float(v), float(s), u, freedom=fit.freedom)
        for name, v, s, u in zip(NAMES, values, std, UNITS, strict=True)
    )
    return PayloadCalibration(
        mass, cog, fit.values[4:].copy(), estimates,
        (float(fit.noise[0]), float(fit.noise[1])),
        (value - flat @ fit.values).reshape(-1, 6), fit.outliers,
        _notes(mass, float(std[0]), fit.outliers),
    )  # fmt: skip


def _check_shapes(model: Model, q: Array, wrench: Array) -> None:
    if q.ndim != 2 or q.shape[1] != model.arm.n:
        raise InputError(f"payload session: found angles {q.shape}, expected (N, {model.arm.n})")
    if wrench.shape != (len(q), 6):
        raise InputError(f"payload session: found wrenches {wrench.shape}, expected {len(q), 6}")
    if not (np.isfinite(q).all() and np.isfinite(wrench).all()):
        row = int(np.flatnonzero(~np.isfinite(np.hstack([q, wrench])).all(axis=1))[0])
        raise InputError(f"payload session: reading {row + 1} is not finite, expected numbers")
    if len(q) < MIN_READINGS:
        raise ExcitationError(
            f"payload session: found {len(q)} reading(s), expected {MIN_READINGS} or more "
            "orientations"
        )


def _require_live(wrench: Array, predicted: Array) -> None:
    """Raise InputError for an axis that never changes though the load found makes it change."""
    still = np.ptp(wrench, axis=0) < 1e-9 * (1.0 + np.abs(wrench[0]))
    change = np.ptp(predicted, axis=0)
    dead = np.flatnonzero(still & (change > np.repeat(MIN_CHANGE, 3)))
    if len(dead):
        axis, unit = AXES[dead[0]], ("N", "Nm")[dead[0] // 3]
        raise InputError(
            f"payload session: found the same {axis} in every orientation, expected it to change "
            f"by {change[dead[0]]:.2g} {unit} with the load on the other axes: is it connected?"
        )


def _require_consistent(wrench: Array, noise: Array) -> None:
    """Raise InputError where no load and bias give such readings: they would weigh nothing."""
    if (wrench == wrench[0]).all():
        raise InputError(
            "payload session: found the same wrench in every orientation, expected a sensor whose "
            "reading turns with gravity: is it connected, and ft_raw_wrench what it reads?"
        )
    for i, unit in enumerate(("N", "Nm")):
        change = float(np.sqrt(wrench[:, 3 * i : 3 * i + 3].var(axis=0).mean()))
        limit = max(MAX_NOISE[i], NOISE_SHARE * change)
        if noise[i] > limit:
            raise InputError(
                f"payload session: found readings {noise[i]:.3g} {unit} (1 sigma) from those of "
                f"any load and bias, expected at most {limit:.3g} {unit}: axes, signs or units of "
                "the sensor are not those of a log (flange axes, N, Nm), or something touched it"
            )


def _require_rotation(columns: Array, count: int) -> None:
    scaled = columns * np.array([0.1, *[0.1] * 3, 1, 1, 1, 1, 1, 1])  # gravity brought near one
    size = np.linalg.svd(scaled.reshape(-1, 10), compute_uv=False)
    # a rotation below about a degree does not separate the load from noise
    if size[-1] < 0.02 * np.sqrt(count):
        raise ExcitationError(
            f"payload session: in {count} readings gravity hardly turns in the flange, so that "
            "load and sensor bias cannot be separated; expected orientations tens of degrees "
            "apart about two axes"
        )


def _in_terms_of_cog(values: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the covariance with the centre of gravity for mass times it, and that centre (m)."""
    mass, moment = float(values[0]), values[1:4]
    if abs(mass) < MIN_MASS_SIGMAS * np.sqrt(covariance[0, 0]):
        bounded = covariance.copy()
        bounded[1:4, :] = bounded[:, 1:4] = 0.0
        bounded[1:4, 1:4] = np.diag([np.inf] * 3)
        return bounded, np.zeros(3)
    T = np.eye(10)
    T[1:4, 1:4] = np.eye(3) / mass
    T[1:4, 0] = -moment / mass**2
    return T @ covariance @ T.T, moment / mass


def _notes(mass: float, std: float, outliers: NDArray[np.int64]) -> tuple[Note, ...]:
    notes = []
    if abs(mass) < MIN_MASS_SIGMAS * std:
        notes.append(Note(Reason.NOTHING_WEIGHS))
    elif mass < 0:
        notes.append(Note(Reason.NEGATIVE_MASS, (mass,)))
    if len(outliers):
        notes.append(Note(Reason.READINGS_DOWN, (tuple(int(r) + 1 for r in outliers),)))
    return tuple(notes)
