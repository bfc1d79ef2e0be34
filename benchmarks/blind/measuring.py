"""The instrument: what a tracker reads of an arm, its noise, and derivatives of the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from benchmarks.blind.mechanics import Array, RealArm, Session, Shape, loads_of, stand, turn


@dataclass(frozen=True)
class Instrument:
    """A tracker: where its frame is, how noisy it is, what it measures."""

    registered: bool
    rotation: Array  # (3, 3) base in tracker
    position: Array  # (3,)
    sigma: float  # m, one coordinate
    sigma_turn: float | None  # rad; None where it measures positions alone
    joint_sigma: float  # rad, the arm's repeatability, drawn anew at every pose
    freedom: float | None = None  # of Student's t, where the noise has long tails


def gap(real: Shape, model: Shape) -> Array:
    """Return TCP (N, 3), or TCP and rotation vector (N, 6), real minus model, in base."""
    return np.column_stack([real.tcp - model.tcp, small_turn(real, model)])


def small_turn(real: Shape, model: Shape) -> Array:
    """Return the rotation vectors (N, 3) from model to real TCP axes, in base; small ones."""
    between = real.tcp_rotation @ np.swapaxes(model.tcp_rotation, 1, 2)
    return 0.5 * np.column_stack([
        between[:, 2, 1] - between[:, 1, 2],
        between[:, 0, 2] - between[:, 2, 0],
        between[:, 1, 0] - between[:, 0, 1],
    ])  # fmt: skip


def frame_columns(shape: Shape, with_rotation: bool) -> Array:
    """Return d gap / d frame (N * k, 6): what an unknown tracker frame can take up."""
    count = len(shape.tcp)
    out = np.zeros((count, 6 if with_rotation else 3, 6))
    out[:, :3, :3] = np.eye(3)
    x, y, z = shape.tcp.T
    out[:, 0, 4], out[:, 0, 5] = z, -y
    out[:, 1, 3], out[:, 1, 5] = -z, x
    out[:, 2, 3], out[:, 2, 4] = y, -x
    if with_rotation:
        out[:, 3:, 3:] = np.eye(3)
    return out.reshape(-1, 6)


def without(columns: Array, values: Array) -> Array:
    """Return values (m,) or (m, k) with the span of columns (m, c) taken out."""
    if columns.shape[1] == 0:
        return values
    scale = np.linalg.norm(columns, axis=0)
    kept = columns[:, scale > 0] / scale[scale > 0]
    base, size, _ = np.linalg.svd(kept, full_matrices=False)
    base = base[:, size > 1e-9 * size[0]] if len(size) else base
    return values - base @ (base.T @ values)


def joint_lever(shape: Shape) -> Array:
    """Return d TCP / d joint angle (n, N, 3), of the arm as it stands."""
    axis = shape.axes[..., 2]
    return np.cross(axis, shape.tcp - shape.origin)


def axial_moments(arm: RealArm, session: Session) -> Array:
    """Return the moments about the joints' axes (N, n) in Nm."""
    shape = stand(arm, session)
    loads = loads_of(arm, session, shape)
    return np.column_stack([
        np.einsum("ij,ij->i", shape.axes[i][:, :, 2], loads.about(shape.origin[i], i))
        for i in range(arm.n)
    ])  # fmt: skip


def floor_of(shape: Shape, instrument: Instrument) -> float:
    """Return the true noise floor, m rms per coordinate: instrument and repeatability."""
    arm = (joint_lever(shape) ** 2).sum(axis=0).mean()
    return float(np.sqrt(instrument.sigma**2 + arm * instrument.joint_sigma**2))


def read_arm(
    arm: RealArm,
    session: Session,
    instrument: Instrument,
    rng: Generator,
    misread: Callable[[Session, Array], Array] | None = None,
) -> tuple[Array, Array | None]:
    """Return measured positions (N, 3) and rotation vectors (N, 3) or None, in the tracker."""
    shaken = replace(
        arm,
        angle_errors=(
            *arm.angle_errors,
            _constant(noise(instrument, instrument.joint_sigma, session.q.shape, rng)),
        ),
    )
    shape = stand(shaken, session)
    position = shape.tcp @ instrument.rotation.T + instrument.position
    if misread is not None:
        position = misread(session, position)
    position = position + noise(instrument, instrument.sigma, position.shape, rng)
    if instrument.sigma_turn is None:
        return position, None
    shake = turn(noise(instrument, instrument.sigma_turn, position.shape, rng))
    return position, Rotation.from_matrix(
        shake @ instrument.rotation @ shape.tcp_rotation
    ).as_rotvec()


def noise(instrument: Instrument, sigma: float, shape: tuple[int, ...], rng: Generator) -> Array:
    """Return noise of this standard deviation: normal, or Student's t with long tails."""
    if instrument.freedom is None:
        return rng.normal(0, sigma, shape)
    spread = np.sqrt(instrument.freedom / (instrument.freedom - 2))
    return np.asarray(rng.standard_t(instrument.freedom, shape) * sigma / spread)


def _constant(values: Array) -> Callable[[Session], Array]:
    return lambda session: values
