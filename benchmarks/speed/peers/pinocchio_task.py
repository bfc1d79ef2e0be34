"""The same task on Pinocchio: its C++ for frames and wrenches, numpy (or numba) around it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio
from numba import njit
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import Chain, Rows

Array = NDArray[np.float64]


class PinocchioTask:
    """One arm in Pinocchio; payload as part of the last link, as its users do it."""

    def __init__(self, chain: Chain, row: Rows) -> None:
        self.chain, n = chain, len(chain.mass)
        self.model = model = pinocchio.Model()
        self.joints = []
        parent = 0
        for i in range(n):
            place = pinocchio.SE3(chain.rotation[i], chain.position[i])
            parent = model.addJoint(parent, pinocchio.JointModelRZ(), place, f"joint{i + 1}")
            body = pinocchio.Inertia(float(chain.mass[i]), chain.cog[i], np.zeros((3, 3)))
            model.appendBodyToJoint(parent, body, pinocchio.SE3.Identity())
            self.joints.append(parent)
        flange = pinocchio.SE3(chain.rotation[n], chain.position[n])
        held = pinocchio.Inertia(float(row.payload_mass[0]), row.payload_cog[0], np.zeros((3, 3)))
        model.appendBodyToJoint(parent, held, flange)
        tool = flange * pinocchio.SE3(chain.tool_rotation, chain.tool_position)
        kind = pinocchio.FrameType.OP_FRAME
        self.tcp = model.addFrame(pinocchio.Frame("tcp", parent, 0, tool, kind))
        model.gravity.linear = chain.gravity
        self.data = model.createData()
        self.zero = np.zeros(n)
        self.outside = [pinocchio.Force.Zero() for _ in range(n + 1)]
        self.none = [pinocchio.Force.Zero() for _ in range(n + 1)]
        self.place = (np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)))

    def regressor(self, q: Array, wrench: Array) -> tuple[Array, Array]:
        """Return regressor (3, 2n) and Jacobian (3, n) of the TCP's position."""
        model, data, n = self.model, self.data, len(q)
        pinocchio.computeJointJacobians(model, data, q)
        pinocchio.updateFramePlacements(model, data)
        tcp = data.oMf[self.tcp].translation
        last = data.oMi[self.joints[-1]]
        pull = pinocchio.Force(wrench[:3], wrench[3:] + np.cross(tcp, wrench[:3]))
        self.outside[-1] = last.actInv(pull)
        pinocchio.rnea(model, data, q, self.zero, self.zero, self.outside)
        J = pinocchio.getFrameJacobian(
            model, data, self.tcp, pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )[:3]
        A = np.empty((3, 2 * n))
        for i, joint in enumerate(self.joints):
            R, o = data.oMi[joint].rotation, data.oMi[joint].translation
            moment = -(R @ data.f[joint].angular)  # what the links beyond do to the joint
            z = R[:, 2]
            axial = z * (z @ moment)
            A[:, i] = np.cross(axial, tcp - o)
            A[:, n + i] = np.cross(moment - axial, tcp - o)
        return A, J

    def setpoint(self, q: Array, wrench: Array, c: Array, damping: float) -> tuple[Array, Array]:
        """Return joint step (n,) and deflection (3,), with numpy around Pinocchio."""
        A, J = self.regressor(q, wrench)
        e = A @ c
        return J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(3), -e), e

    def setpoint_glued(
        self, q: Array, wrench: Array, c: Array, damping: float
    ) -> tuple[Array, Array]:
        """Return the same with numba around Pinocchio, and the pull added there."""
        model, data = self.model, self.data
        pinocchio.rnea(model, data, q, self.zero, self.zero)
        rotation, origin, angular = self.place
        for i, joint in enumerate(self.joints):
            placed, carried = data.oMi[joint], data.f[joint]
            rotation[i], origin[i] = placed.rotation, placed.translation
            angular[i] = carried.angular
        found: Any = _glue(rotation, origin, angular, self.chain, wrench, c, damping)
        return found[0], found[1]


@njit(cache=True, error_model="numpy")  # type: ignore[misc,untyped-decorator,unused-ignore]
def _glue(rotation, origin, angular, chain, wrench, c, damping):  # type: ignore[no-untyped-def]
    n = origin.shape[0]
    last = rotation[n - 1]
    flange = origin[n - 1] + last @ chain.position[n]
    tcp = flange + last @ (chain.rotation[n] @ chain.tool_position)
    e, J, G = np.zeros(3), np.empty((3, n)), np.eye(3) * damping**2
    for i in range(n):
        lever = tcp - origin[i]
        moment = wrench[3:] + np.cross(lever, wrench[:3]) - rotation[i] @ angular[i]
        z = np.ascontiguousarray(rotation[i][:, 2])
        axial = z * np.dot(z, moment)
        e += np.cross(c[i] * axial + c[n + i] * (moment - axial), lever)
        J[:, i] = np.cross(z, lever)
    G += J @ J.T
    return J.T @ np.linalg.solve(G, -e), e
