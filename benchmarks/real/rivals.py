"""Plain least squares in every channel: what a textbook gets of the same rows.

Positions: frame, tool point and the geometry of all links. Wrenches: bias, weight and its centre
of gravity. Torques: base parameters with Coulomb, viscous and constant friction and the rotors'
inertia. Tracking: one delay a joint.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.real import arms
from benchmarks.real.geometry import fit_geometry, points, registered
from benchmarks.real.table import Table, links_of

Array = NDArray[np.float64]
SMOOTH = 0.2  # s, window of the derivatives
MOST = 3000  # rows of a recording that are fitted


def position_left(cell: dict[str, Any], fitted: Table, judged: Table) -> Array:
    """Return the vectors (N, 3) that the geometric least squares leave of judged positions."""
    links, tool = _rows_of(cell), np.array(cell["tool"]["tcp"]["xyz"], dtype=float)
    q, measured = fitted.joints(), _needed(fitted, "measured_position")
    step = max(1, len(q) // MOST)
    session = sessions(fitted)[::step]
    fit = fit_geometry(links, q[::step], measured[::step], session, tool)
    own = np.minimum(sessions(judged), len(fit.tool) - 1)
    return left_of(points(links, judged.joints(), fit, own), judged)


def left_of(predicted: Array, judged: Table) -> Array:
    """Return measured minus predicted positions (N, 3), the frame of each session fitted."""
    measured, session = _needed(judged, "measured_position"), sessions(judged)
    out = np.empty_like(measured)
    for s in np.unique(session):
        own = session == s
        out[own] = measured[own] - registered(predicted[own], measured[own])
    return out


def sessions(table: Table) -> NDArray[np.int64]:
    """Return the number of each row's session (N,)."""
    column = table.get("session")
    return np.zeros(len(table), dtype=np.int64) if column is None else column.astype(np.int64)


def wrench_corrected(cell: dict[str, Any], fitted: Table, judged: Table) -> Table:
    """Return the judged log without the bias and weight that least squares find in the fitted."""
    A, b = _wrench_rows(cell, fitted), _needed(fitted, "ft_raw_wrench").ravel()
    values = np.linalg.lstsq(A, b, rcond=1e-10)[0]
    error = (_wrench_rows(cell, judged) @ values).reshape(-1, 6)
    return judged.replaced("ft_raw_wrench", _needed(judged, "ft_raw_wrench") - error)


def _wrench_rows(cell: dict[str, Any], table: Table) -> Array:
    """Return d wrench / d (bias 6, mass, first moment 3), flat rows."""
    links = _rows_of(cell)
    _, R = arms.flange(links, table.joints())
    down = np.einsum("nji,j->ni", R, np.array(cell.get("gravity", [0, 0, -9.80665]), dtype=float))
    out = np.zeros((len(table), 6, 10))
    out[:, :, :6] = np.eye(6)
    out[:, :3, 6] = down
    for k in range(3):
        out[:, 3:, 7 + k] = np.cross(np.eye(3)[k], down)
    return out.reshape(-1, 10)


def tracking_left(fitted: Table, judged: Table) -> Array:
    """Return what one delay a joint, fitted, leaves of the judged following error (N, n).

    nan where the delayed target is not in the log, or a row's time is repeated.
    """
    delay = np.zeros(fitted.joints().shape[1])
    for _ in range(6):
        _, error, speed = _following(fitted, delay)
        delay -= np.sum(speed * error, axis=0) / np.maximum(np.sum(speed**2, axis=0), 1e-12)
    rows, error, _ = _following(judged, delay)
    left = np.full(judged.joints().shape, np.nan)
    left[rows] = error
    return left


def _following(table: Table, delay: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Return rows (m,), actual minus delayed target (m, n), and the delayed target's speed."""
    time, first = np.unique(table.time, return_index=True)  # a log may repeat a row's time
    target, actual = _needed(table, "target_q")[first], _needed(table, "actual_q")[first]
    wanted, speed = np.empty_like(target), np.empty_like(target)
    rate = np.gradient(target, time, axis=0)
    for j in range(target.shape[1]):
        wanted[:, j] = np.interp(time - delay[j], time, target[:, j])
        speed[:, j] = np.interp(time - delay[j], time, rate[:, j])
    began = time >= time[0] + max(float(delay.max()), 0.0)  # before, the target is not in the log
    return first[began], (actual - wanted)[began], speed[began]


def torque_corrected(
    cell: dict[str, Any], folder: Path, fitted: Table, judged: Table, gap: Array
) -> Table:
    """Return the judged log with what base parameters and friction leave as its torques' gap.

    ``gap`` (N, n) is what the cell leaves of the torques. Rows at the edges have no torque.
    """
    import pinocchio as pin  # of the test extra

    model = pinocchio_model(cell, folder, pin)
    A, b = torque_rows(model, pin, fitted, max(1, len(fitted) // MOST))
    n = model.nv
    values = solved(A, b, n)
    A, b = torque_rows(model, pin, judged, 1)
    left = (b - A @ values).reshape(-1, n)
    edge = (len(judged) - len(left)) // 2
    inner = slice(edge, len(judged) - edge)
    torque = _needed(judged, "actual_current_as_torque")
    measured = np.full_like(torque, np.nan)
    measured[inner] = torque[inner] - gap[inner] + left
    return judged.replaced("actual_current_as_torque", measured)


def solved(A: Array, b: Array, n: int) -> Array:
    """Return the least-squares values of flat rows of n joints, each weighed by its scatter."""
    spread, values = np.ones(n), np.zeros(A.shape[1])
    for _ in range(2):
        weight = np.tile(1 / spread, len(b) // n)
        scaled = A * weight[:, None]
        size = np.maximum(np.linalg.norm(scaled, axis=0), 1e-12)
        values = np.linalg.lstsq(scaled / size, b * weight, rcond=1e-6)[0] / size
        spread = np.maximum(np.std((b - A @ values).reshape(-1, n), axis=0), 1e-9)
    return values


def pinocchio_model(cell: dict[str, Any], folder: Path, pin: Any) -> Any:
    """Return the cell's arm as Pinocchio has it, its links without mass where given by rows."""
    gravity = np.array(cell.get("gravity", [0, 0, -9.80665]), dtype=float)
    links = links_of(cell)
    if links is None:
        model = pin.buildModelFromXML((folder / cell["robot"]["urdf"]).read_text(encoding="utf-8"))
        model.gravity.linear = gravity
        return model
    model, parent, place = pin.Model(), 0, pin.SE3.Identity()
    model.gravity.linear = gravity
    for i, link in enumerate(links):
        zero = pin.SE3(pin.utils.rotate("z", link.offset), np.zeros(3))
        parent = model.addJoint(parent, pin.JointModelRZ(), place * zero, f"joint_{i}")
        place = pin.SE3(pin.utils.rotate("x", link.alpha), np.array([link.a, 0, link.d]))
        model.appendBodyToJoint(parent, pin.Inertia.Zero(), pin.SE3.Identity())
    return model


def torque_rows(model: Any, pin: Any, table: Table, step: int) -> tuple[Array, Array]:
    """Return the regressor and the torques of every step-th row, flat; edges left out."""
    q, qd, qdd, window = derivatives(table)
    measured, n = _needed(table, "actual_current_as_torque"), q.shape[1]
    data, blocks, values = model.createData(), [], []
    for t in range(window, len(q) - window, step):
        rigid = pin.computeJointTorqueRegressor(model, data, q[t], qd[t], qdd[t])
        way = np.clip(qd[t] / 0.01, -1, 1)  # at rest the friction has either sign
        own = [np.diag(v) for v in (way, qd[t], np.ones(n), qdd[t])]
        blocks.append(np.hstack([rigid, *own]))
        values.append(measured[t])
    return np.vstack(blocks), np.concatenate(values)


def derivatives(table: Table) -> tuple[Array, Array, Array, int]:
    """Return joints, speeds and accelerations (N, n), smoothed, and the rows of the window.

    Speeds are the measured ones where the log has them. Rows are put on an even clock.
    """
    from scipy.signal import savgol_filter  # takes most of a second to import

    time, q = table.time, table.joints()
    even = np.linspace(time[0], time[-1], len(time))
    dt = float(even[1] - even[0])
    window = max(5, int(SMOOTH / dt) // 2 * 2 + 1)
    speed = table.get("actual_qd")
    if speed is None:
        speed = savgol_filter(_on(even, time, q), window, 3, deriv=1, delta=dt, axis=0)
    else:
        speed = savgol_filter(_on(even, time, speed), window, 3, axis=0)
    rate = savgol_filter(speed, window, 3, deriv=1, delta=dt, axis=0)
    return q, _on(time, even, speed), _on(time, even, rate), window


def _on(clock: Array, time: Array, values: Array) -> Array:
    return np.column_stack([np.interp(clock, time, v) for v in values.T])


def _rows_of(cell: dict[str, Any]) -> tuple[arms.Link, ...]:
    links = links_of(cell)
    if links is None:
        raise ValueError("cell: found a URDF, expected the arm as DH rows for least squares")
    return links


def _needed(table: Table, name: str) -> Array:
    column = table.get(name)
    if column is None:
        raise ValueError(f"log: found no {name}")
    return column
