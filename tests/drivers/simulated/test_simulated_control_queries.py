"""Questions of ur_rtde's control script that few programs ask, asked by the library itself."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_cell import run_client
from simulated_controller import SimulatedController

CONTROL = """
from rtde_receive import RTDEReceiveInterface
from rtde_control import RTDEControlInterface
r = RTDEReceiveInterface(host)
c = RTDEControlInterface(host)
q = r.getActualQ()
def later(ask, *given):
    # the library answers some questions with what the registers held before
    ask(*given)
    time.sleep(0.02)
    return ask(*given)
"""


def test_where_the_arm_is_was_and_could_be_is_answered(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        CONTROL
        + """
pose = c.getForwardKinematics()
out["pose"], out["flange"] = pose, later(c.getActualToolFlangePose)
c.setTcp([0, 0, 0.1, 0, 0, 0])
out["with_tool"], out["flange_then"] = c.getForwardKinematics(), later(c.getActualToolFlangePose)
out["inverse"] = c.getInverseKinematics(out["with_tool"])
has = c.getInverseKinematicsHasSolution
out["has"] = [has(out["with_tool"], q), has([9.0] * 3 + pose[3:], q)]
out["history"] = later(c.getActualJointPositionsHistory, 5)
out["waypoint"], out["target"] = c.getTargetWaypoint(), r.getTargetTCPPose()
out["contact"] = later(c.toolContact, [0, 0, 1, 0, 0, 0])
out["gravity"] = c.setGravity([0.0, 0.0, 9.82])
out["freedrive"] = c.getFreedriveStatus()
""",
    )
    start = list(controller.settings.start_q)
    shift = np.subtract(out["with_tool"], out["pose"])
    assert np.linalg.norm(shift[:3]) == pytest.approx(0.1, abs=2e-3)
    assert out["flange_then"] == pytest.approx(out["flange"], abs=1e-9)  # a tool moves no flange
    assert out["inverse"] == pytest.approx(start, abs=1e-6)
    assert out["has"] == [True, False]
    assert out["history"] == pytest.approx(start, abs=1e-9)  # it stands still
    assert out["waypoint"] == pytest.approx(out["target"], abs=0.11)
    assert out["contact"] == 0
    assert out["gravity"]
    assert out["freedrive"] == 0
