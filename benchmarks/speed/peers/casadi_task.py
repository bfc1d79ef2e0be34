"""One setpoint in CasADi's virtual machine, where CasADi is installed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import Chain, Rows

Array = NDArray[np.float64]


def casadi_setpoint(
    chain: Chain, row: Rows, q: Array, damping: float
) -> tuple[Any, tuple[Array, Array]] | None:
    """Return a call without arguments, and step (6,) and deflection (3,); None: no CasADi."""
    try:
        import casadi as ca
    except ImportError:
        return None
    n = len(q)
    x, pull = ca.SX.sym("q", n), ca.SX.sym("w", 6)
    R, o, rotation, origin = ca.SX.eye(3), ca.SX.zeros(3), [], []
    for i in range(n):
        c, s = ca.cos(x[i]), ca.sin(x[i])
        turn = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
        o = o + R @ chain.position[i]
        R = R @ ca.DM(chain.rotation[i]) @ turn
        rotation.append(R)
        origin.append(o)
    o = o + R @ chain.position[n]
    R = R @ ca.DM(chain.rotation[n])
    tcp = o + R @ chain.tool_position
    weight = float(row.payload_mass[0]) * chain.gravity
    force = pull[:3] + weight
    about = pull[3:] + ca.cross(tcp, pull[:3]) + ca.cross(o + R @ row.payload_cog[0], weight)
    e, columns = ca.SX.zeros(3), []
    for i in range(n - 1, -1, -1):
        weight = chain.mass[i] * chain.gravity
        force = force + weight
        about = about + ca.cross(origin[i] + rotation[i] @ chain.cog[i], weight)
        moment = rotation[i].T @ (about - ca.cross(origin[i], force))
        lever = tcp - origin[i]
        e = e + ca.cross(rotation[i] @ (ca.DM(chain.compliance[i]) * moment), lever)
        columns.insert(0, ca.cross(rotation[i][:, 2], lever))
    J = ca.horzcat(*columns)
    step = J.T @ ca.solve(J @ J.T + damping**2 * ca.DM.eye(3), -e)
    function = ca.Function("setpoint", [x, pull], [ca.densify(step), ca.densify(e)])
    buffer, trigger = function.buffer()
    given = (q.copy(), row.wrench[0].copy(), np.zeros(n), np.zeros(3))
    buffer.set_arg(0, memoryview(given[0]))
    buffer.set_arg(1, memoryview(given[1]))
    buffer.set_res(0, memoryview(given[2]))
    buffer.set_res(1, memoryview(given[3]))

    def call(kept: Any = (buffer, function, given)) -> None:  # the buffer must outlive the call
        trigger()

    call()
    return call, (given[2].copy(), given[3].copy())
