"""A command's whole job by other libraries: a script as their users write it, run as a process.

    python -m benchmarks.speed.peers.whole_jobs LIBRARY JOB LOG ARM.npz FLEXIBILITIES.npy OUT

LIBRARY is pinocchio or mujoco, JOB is fit, predict or compensate, LOG the Parquet file that ours
reads. The mechanics come from the library, row by row, a model for each payload; all else is numpy
over all rows. To first order (eqs. 3 and 4 of docs/conventions.md), without standard deviations,
checks or notes. The fit is scipy's least_squares with a robust loss, or the optimiser of MuJoCo's
sysid, which has none; both on exact first-order columns.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import NDArray
from pyarrow import parquet

Array = NDArray[np.float64]
NOISE = 3e-5  # m
LEVER = 0.5  # m, as in core.kernels.single
# places of the joints (N, n, 3, 3) and (N, n, 3), moment of what is beyond about them (N, n, 3)
Statics = tuple[Array, Array, Array]


def by_pinocchio(arm: dict[str, Array], mass: float, cog: Array, q: Array) -> Statics:
    """Return the statics of rows under one payload."""
    import pinocchio

    n = len(arm["mass"])
    model, parent, joints = pinocchio.Model(), 0, []
    for i in range(n):
        place = pinocchio.SE3(arm["rotation"][i], arm["position"][i])
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), place, f"joint{i + 1}")
        body = pinocchio.Inertia(float(arm["mass"][i]), arm["cog"][i], np.zeros((3, 3)))
        model.appendBodyToJoint(parent, body, pinocchio.SE3.Identity())
        joints.append(parent)
    flange = pinocchio.SE3(arm["rotation"][n], arm["position"][n])
    model.appendBodyToJoint(parent, pinocchio.Inertia(mass, cog, np.zeros((3, 3))), flange)
    model.gravity.linear = arm["gravity"]
    data, zero = model.createData(), np.zeros(n)
    R, o, M = (np.empty((len(q), n, *shape)) for shape in ((3, 3), (3,), (3,)))
    for r, angles in enumerate(q):
        pinocchio.forwardKinematics(model, data, angles)  # rnea leaves the joints' places alone
        pinocchio.rnea(model, data, angles, zero, zero)
        for i, joint in enumerate(joints):
            placed = data.oMi[joint]
            R[r, i], o[r, i], M[r, i] = placed.rotation, placed.translation, data.f[joint].angular
    return R, o, -(R @ M[..., None])[..., 0]


def by_mujoco(arm: dict[str, Array], mass: float, cog: Array, q: Array) -> Statics:
    """Return the statics of rows under one payload."""
    import mujoco

    n, spec = len(arm["mass"]), mujoco.MjSpec()
    spec.option.gravity = arm["gravity"]
    body = spec.worldbody
    for i in range(n + 1):
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, arm["rotation"][i].ravel())
        body = body.add_body(name=f"b{i}", pos=arm["position"][i], quat=turn)
        weight, centre = (arm["mass"][i], arm["cog"][i]) if i < n else (mass, cog)
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = max(weight, 1e-9), centre, [1e-9] * 3
        if i < n:
            body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    model = spec.compile()
    data = mujoco.MjData(model)
    first = model.body("b0").id
    R, o, f, c = (np.empty((len(q), *shape)) for shape in ((n, 9), (n, 3), (n, 6), (3,)))
    for r, angles in enumerate(q):
        data.qpos[:] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        R[r], o[r] = data.xmat[first : first + n], data.xpos[first : first + n]
        f[r], c[r] = data.cfrc_int[first : first + n], data.subtree_com[first]
    moment = f[..., :3] + np.cross(c[:, None] - o, f[..., 3:])
    return R.reshape(len(q), n, 3, 3), o, -moment


def statics_of(mechanics: Callable[..., Statics], arm: dict[str, Array], log: Any) -> Statics:
    """Return the statics of all rows."""
    q = np.column_stack([log[f"actual_q_{i}"].to_numpy() for i in range(len(arm["mass"]))])
    mass = log["payload"].to_numpy()
    cog = np.column_stack([log[f"payload_cog_{i}"].to_numpy() for i in range(3)])
    keys, group = np.unique(np.column_stack([mass, cog]), axis=0, return_inverse=True)
    parts = [np.flatnonzero(group.ravel() == g) for g in range(len(keys))]
    found = [mechanics(arm, float(k[0]), k[1:], q[p]) for k, p in zip(keys, parts, strict=True)]
    order = np.argsort(np.concatenate(parts))
    R, o, M = (np.concatenate(own)[order] for own in zip(*found, strict=True))
    return R, o, M


def columns(arm: dict[str, Array], R: Array, o: Array, M: Array) -> tuple[Array, ...]:
    """Return TCP (N, 3), (N, 3, 3), its columns (N, 6, 2n) and the Jacobian (N, 6, n)."""
    turn = R[:, -1] @ arm["rotation"][-1]
    flange = o[:, -1] + R[:, -1] @ arm["position"][-1]
    tcp = flange + turn @ arm["tool_position"]
    z, lever = R[..., 2], tcp[:, None] - o
    axial = z * np.sum(z * M, axis=-1, keepdims=True)
    parts = [np.concatenate([np.cross(v, lever), v], axis=-1) for v in (axial, M - axial, z)]
    A = np.concatenate(parts[:2], axis=1).transpose(0, 2, 1)
    return tcp, turn @ arm["tool_rotation"], A, parts[2].transpose(0, 2, 1)


def rotated(v: Array) -> Array:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(v).as_matrix())


def predict(arm: dict[str, Array], found: tuple[Array, ...], c: Array, out: str) -> None:
    """Write the poses as Parquet."""
    from scipy.spatial.transform import Rotation

    tcp, turn, A, _ = found
    moved = A @ c
    vector = Rotation.from_matrix(rotated(moved[:, 3:]) @ turn).as_rotvec()
    table = np.column_stack([tcp + moved[:, :3], vector])
    names = [f"predicted_{kind}_{k}" for kind in ("position", "rotation") for k in range(3)]
    parquet.write_table(pyarrow.table(list(table.T), names), out)


def compensate(arm: dict[str, Array], found: tuple[Array, ...], c: Array, q: Array) -> Array:
    """Return the setpoints one damped step away."""
    _, _, A, J = found
    weigh = np.array([1.0] * 3 + [LEVER] * 3)
    J, away = J * weigh[:, None], (A @ c) * weigh
    step = np.linalg.solve(J @ J.transpose(0, 2, 1) + 1e-8 * np.eye(6), -away[..., None])
    return np.asarray(q + (J.transpose(0, 2, 1) @ step)[..., 0])


def residual_of(tcp: Array, turn: Array, A: Array, measured: Array) -> Callable[[Array], Array]:
    """Return the gap in units of the noise by frame (6), tool point (3) and flexibilities."""

    def residual(x: Array) -> Array:
        frame = measured @ rotated(x[None, :3])[0].T + 1e-3 * x[3:6]
        return np.asarray(
            ((frame - tcp - turn @ (1e-3 * x[6:9]) - A @ (1e-6 * x[9:])) / NOISE).ravel()
        )

    return residual


def fit(library: str, found: tuple[Array, ...], measured: Array) -> Array:
    """Return the flexibilities (2n,) rad/Nm, none of them negative."""
    tcp, turn, A, _ = found
    residual, size = residual_of(tcp, turn, A[:, :3], measured), 9 + A.shape[2]
    begin = np.concatenate([np.zeros(9), np.full(A.shape[2], 5.0)])
    if library == "pinocchio":
        from scipy.optimize import least_squares

        low = np.where(np.arange(size) < 9, -np.inf, 0.0)
        done = least_squares(residual, begin, bounds=(low, np.inf), loss="soft_l1", f_scale=2.0)
        return np.asarray(1e-6 * done.x[9:])
    from mujoco import sysid

    parameters = sysid.ParameterDict()
    for k in range(size):
        bounds = (-1e3, 1e3) if k < 9 else (0.0, 1e3)
        parameters.add(sysid.Parameter(f"p{k:02d}", begin[k], *bounds))

    def whole(x: Array, _: Any) -> tuple[list[Array], list[Any], list[Any]]:
        many = np.asarray(x).reshape(size, -1).T  # the optimiser asks for all differences at once
        return [np.stack([residual(one) for one in many], axis=-1)], [], []

    _, done = sysid.optimize(parameters, whole, verbose=False)
    return np.asarray(1e-6 * np.ravel(done.x)[9:])


def main(library: str, job: str, *files: str) -> None:
    """Do the job."""
    log_file, arm_file, flexibility_file, out = files
    with np.load(arm_file) as stored:
        arm = {name: stored[name] for name in stored.files}
    log = parquet.read_table(log_file)
    mechanics = {"pinocchio": by_pinocchio, "mujoco": by_mujoco}[library]
    found = columns(arm, *statics_of(mechanics, arm, log))
    if job == "fit":
        measured = np.column_stack([log[f"measured_position_{k}"].to_numpy() for k in range(3)])
        np.save(out, fit(library, found, measured))
        return
    c = np.load(flexibility_file)
    if job == "predict":
        predict(arm, found, c, out)
        return
    q = np.column_stack([log[f"actual_q_{i}"].to_numpy() for i in range(len(arm["mass"]))])
    names = [f"corrected_q_{i}" for i in range(q.shape[1])]
    parquet.write_table(pyarrow.table(list(compensate(arm, found, c, q).T), names), Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
