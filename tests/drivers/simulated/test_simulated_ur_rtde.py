"""The real ur_rtde library, unmodified, against the simulated controller."""

from __future__ import annotations

import pytest
from rtde_client import RtdeClient
from simulated_cell import Bench, cell_settings, run_client
from simulated_controller import SimulatedController

NO_HANDSHAKE_WAIT = 3.9  # s: the library gives up on a broken handshake after 4


def test_receive_reads_the_whole_default_recipe(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        """
        from rtde_receive import RTDEReceiveInterface
        r = RTDEReceiveInterface(host)
        out["q"] = r.getActualQ()
        out["raw"] = r.getFtRawWrench()
        out["temperatures"] = r.getJointTemperatures()
        out["mode"] = [r.getRobotMode(), r.getSafetyMode(), r.getRuntimeState()]
        slower = []
        for _ in range(5):  # a busy machine holds some of them up
            first, begun = r.getTimestamp(), time.monotonic()
            until(lambda: r.getTimestamp() - first > 0.5)
            slower.append(time.monotonic() - begun - (r.getTimestamp() - first))
        out["slower"] = sorted(slower)[2]
        out["connected"] = r.isConnected()
        """,
    )
    assert out["q"] == pytest.approx(controller.settings.start_q)
    assert out["raw"] != [0.0] * 6
    assert all(20.0 < t < 40.0 for t in out["temperatures"])
    assert out["mode"] == [7, 1, 1]
    assert abs(out["slower"]) < 0.4
    assert out["connected"]


CONTROL = """
from rtde_receive import RTDEReceiveInterface
from rtde_control import RTDEControlInterface
r = RTDEReceiveInterface(host)
c = RTDEControlInterface(host)
q = r.getActualQ()
def apart(found, expected):
    return max(abs(a - b) for a, b in zip(found, expected))
def near(goal):
    until(lambda: apart(r.getActualQ(), goal) < 1e-6)
    return apart(r.getActualQ(), goal) < 1e-6
"""


def test_moves_reach_their_goals(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        CONTROL
        + """
goal = [q[0] + 0.2] + q[1:]
out["joints"] = c.moveJ(goal, 1.0, 2.0) and near(goal)
pose = r.getTargetTCPPose()
pose[2] += 0.05
start = r.getTargetTCPPose()
out["line"] = c.moveL(pose, 0.25, 1.2)
until(lambda: apart(r.getActualTCPPose(), pose) < 1e-6)
out["reached"] = [a - b for a, b in zip(r.getActualTCPPose(), pose)]
out["to_pose"] = c.moveJ_IK(start, 1.0, 2.0) and near(goal)
out["fk_line"] = c.moveL_FK(q, 0.5, 1.2) and near(q)
out["asynchronous"] = c.moveJ(goal, 0.05, 1.0, True)
out["running"] = c.getAsyncOperationProgress()
until(lambda: r.getActualQ()[0] > q[0] + 0.01)
c.stopJ(4.0)
out["halfway"] = r.getActualQ()[0] - q[0]
until(lambda: c.getAsyncOperationProgress() < 0)
out["progress_after"] = c.getAsyncOperationProgress()
out["stays"] = r.getActualQ()[0] - q[0] - out["halfway"]
""",
    )
    assert out["joints"]
    assert out["line"]
    assert max(map(abs, out["reached"])) < 1e-6
    assert out["to_pose"]
    assert out["fk_line"]
    assert out["asynchronous"]
    assert out["running"] >= 0
    assert 0.0 < out["halfway"] < 0.2
    assert out["progress_after"] < 0
    assert abs(out["stays"]) < 0.05


def test_servo_and_speed_follow_a_stream(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        CONTROL
        + """
goal = list(q)
for i in range(250):
    t = c.initPeriod()
    goal[0] = q[0] + 0.1 * (i + 1) / 250
    assert c.servoJ(goal, 0.5, 0.5, 0.002, 0.05, 300)
    c.waitPeriod(t)
out["servo"] = near(goal)
out["stopped"] = c.servoStop()
def commanded(send, read, goal):
    assert send()
    return abs(read() - goal) < 0.001
turn, lift = [0.0, 0.0, 0.0, 0.0, 0.0, 0.5], [0.0, 0.0, 0.05, 0.0, 0.0, 0.0]
until(lambda: commanded(lambda: c.speedJ(turn, 5.0, 0.0), lambda: r.getActualQd()[5], 0.5))
out["speed"] = r.getActualQd()[5]
out["speed_stopped"] = c.speedStop()
until(lambda: commanded(lambda: c.speedL(lift, 1.0, 0.0), lambda: r.getActualTCPSpeed()[2], 0.05))
out["tool_speed"] = r.getActualTCPSpeed()
c.speedStop()
pose = r.getActualTCPPose()
pose[0] += 0.002
for i in range(100):
    c.servoL(pose, 0.5, 0.5, 0.002, 0.05, 300)
    time.sleep(0.002)
until(lambda: abs(r.getActualTCPPose()[0] - pose[0]) < 1e-5)
out["servo_line"] = r.getActualTCPPose()[0] - pose[0]
c.servoStop()
""",
    )
    assert out["servo"]
    assert out["stopped"]
    assert out["speed"] == pytest.approx(0.5, abs=0.01)
    assert out["speed_stopped"]
    assert out["tool_speed"][2] == pytest.approx(0.05, abs=0.002)
    assert max(map(abs, out["tool_speed"][:2])) < 0.002
    assert abs(out["servo_line"]) < 1e-5


def test_settings_and_questions_are_answered(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        CONTROL
        + """
begun = time.monotonic()
out["payload"] = c.setPayload(3.0, [0.0, 0.01, 0.05])
until(lambda: r.getPayload() == 3.0)
out["declared"] = [r.getPayload(), *r.getPayloadCog()]
out["target_payload"] = c.setTargetPayload(2.0, [0.0, 0.0, 0.04], [0.1, 0.1, 0.1, 0, 0, 0])
c.setTcp([0, 0, 0.1, 0, 0, 0])
out["tcp"] = c.getTCPOffset()
until(lambda: apart(r.getActualTCPPose(), c.getForwardKinematics(q, [0, 0, 0.1, 0, 0, 0])) < 1e-6)
pose = r.getActualTCPPose()
out["inverse"] = c.getInverseKinematics(pose, q)
out["default"] = c.getForwardKinematics()
out["forward"] = c.getForwardKinematics(q, [0, 0, 0.1, 0, 0, 0])
out["pose"] = pose
out["joints_safe"] = [c.isJointsWithinSafetyLimits(q), c.isJointsWithinSafetyLimits([9.0] + q[1:])]
out["pose_safe"] = c.isPoseWithinSafetyLimits(pose)
has = c.getInverseKinematicsHasSolution
out["has"] = [has(pose), has([9.0] * 3 + pose[3:])]
out["steady"] = c.isSteady()
until(lambda: abs(c.getStepTime() - 0.002) < 1e-9)
out["step"] = c.getStepTime()
until(lambda: abs(c.getJointTorques()[1]) > 20.0)
out["torques"] = c.getJointTorques()
out["trans"] = c.poseTrans([1, 0, 0, 0, 0, 1.5707963267948966], [1, 0, 0, 0, 0, 0])
c.zeroFtSensor()
until(lambda: apart(r.getActualTCPForce()[:3], [0.0] * 3) < 2.0)
out["force"] = r.getActualTCPForce()
out["jog"] = c.jogStart([0, 0, 0.02, 0, 0, 0], 0) and c.jogStop()
out["freedrive"] = c.freedriveMode() and c.endFreedriveMode()
out["teach"] = c.teachMode() and c.endTeachMode()
out["seconds"] = time.monotonic() - begun
""",
    )
    assert out["payload"]
    assert out["declared"] == [3.0, 0.0, 0.01, 0.05]
    assert out["target_payload"]
    assert out["tcp"] == pytest.approx([0, 0, 0.1, 0, 0, 0])
    assert out["inverse"] == pytest.approx(controller.settings.start_q, abs=1e-6)
    assert out["default"] == pytest.approx(out["pose"], abs=1e-9)
    assert out["forward"] == pytest.approx(out["pose"], abs=1e-9)
    assert out["joints_safe"] == [True, False]
    assert out["pose_safe"]
    assert out["has"] == [True, False]
    assert out["steady"]
    assert out["step"] == pytest.approx(0.002)
    assert abs(out["torques"][1]) > 20.0
    assert out["trans"] == pytest.approx([1, 1, 0, 0, 0, 1.5707963267948966])
    assert max(map(abs, out["force"][:3])) < 2.0
    assert out["jog"]
    assert out["freedrive"]
    assert out["teach"]
    assert out["seconds"] < NO_HANDSHAKE_WAIT


def test_paths_and_custom_scripts_run_and_the_control_script_comes_back(
    controller: SimulatedController,
) -> None:
    out = run_client(
        controller.host,
        CONTROL
        + """
a = [q[0] + 0.1] + q[1:]
b = [q[0] + 0.15] + q[1:]
out["path"] = c.moveJ([a + [1.0, 2.0, 0.0], b + [1.0, 2.0, 0.0]]) and near(b)
lines = ["movej(%s, a=2.0, v=1.0)" % q, "m = 1.5", "set_payload(m, [0, 0, 0.1])",
    "sleep(0.02)", "nonsense here"]
out["script"] = c.sendCustomScriptFunction("wiggle", "\\n".join(lines))
out["there"] = near(q)
out["payload"] = r.getPayload()
out["after"] = c.moveJ(a, 1.0, 2.0) and near(a)
out["stopped"] = c.stopScript() or True
until(lambda: r.getRuntimeState() == 1)
out["state"] = r.getRuntimeState()
out["reupload"] = c.reuploadScript()
until(c.isProgramRunning)
out["again"] = c.moveJ(q, 1.0, 2.0) and near(q)
""",
    )
    assert out["path"]
    assert out["script"]
    assert out["there"]
    assert out["payload"] == 1.5
    assert out["after"]
    assert out["state"] == 1
    assert out["reupload"]
    assert out["again"]
    assert "'nonsense here' is not understood" in controller.log()


def test_the_upper_register_range_works_as_the_lower_one(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        """
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface
        kind = RTDEControlInterface
        flags = kind.FLAG_UPLOAD_SCRIPT | kind.FLAG_UPPER_RANGE_REGISTERS
        c = kind(host, 500.0, flags)
        r = RTDEReceiveInterface(host)
        q = r.getActualQ()
        begun = time.monotonic()
        out["move"] = c.moveJ([q[0] + 0.05] + q[1:], 1.0, 2.0)
        out["forward"] = c.getForwardKinematics()
        until(lambda: max(map(abs, r.getActualQd())) < 1e-9)
        out["pose"] = r.getActualTCPPose()
        out["seconds"] = time.monotonic() - begun
        """,
    )
    assert out["move"]
    assert out["forward"] == pytest.approx(out["pose"], abs=1e-4)
    assert out["seconds"] < NO_HANDSHAKE_WAIT


def test_a_starved_watchdog_stops_the_program(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        CONTROL
        + """
c.setWatchdog(0.5)  # 2 s: a busy machine kicks later than it means to
begun = time.monotonic()
while time.monotonic() - begun < 2.5:
    c.kickWatchdog()
    time.sleep(0.02)
out["fed"] = r.getRuntimeState()
until(lambda: r.getRuntimeState() == 1)
out["starved"] = r.getRuntimeState()
until(lambda: not c.isProgramRunning())
out["servo"] = c.servoJ(q, 0.5, 0.5, 0.002, 0.1, 300)
""",
    )
    assert out["fed"] == 2
    assert out["starved"] == 1
    assert not out["servo"]


def test_registers_written_by_io_are_seen_on_the_robot(controller: SimulatedController) -> None:
    out = run_client(
        controller.host,
        """
        from rtde_io import RTDEIOInterface
        from rtde_receive import RTDEReceiveInterface
        io = RTDEIOInterface(host)
        r = RTDEReceiveInterface(host)
        out["written"] = [io.setInputIntRegister(19, 123), io.setInputDoubleRegister(22, 0.125),
            io.setStandardDigitalOut(3, True), io.setConfigurableDigitalOut(1, True),
            io.setToolDigitalOut(0, True), io.setSpeedSlider(0.5),
            io.setAnalogOutputVoltage(0, 0.3)]
        until(lambda: abs(r.getStandardAnalogOutput0() - 3.0) < 1e-6)
        out["bits"] = r.getActualDigitalOutputBits()
        out["speed"] = r.getSpeedScaling()
        out["analog"] = r.getStandardAnalogOutput0()
        """,
    )
    raw = RtdeClient(controller.host)
    raw.outputs("input_int_register_19,input_double_register_22")
    raw.start()
    assert raw.sample() == {"input_int_register_19": 123, "input_double_register_22": 0.125}
    assert all(out["written"])
    assert out["bits"] == 1 << 3 | 1 << 9 | 1 << 16
    assert out["speed"] == 0.5
    assert out["analog"] == pytest.approx(3.0)


def test_a_second_control_client_learns_that_the_registers_are_in_use(
    controller: SimulatedController,
) -> None:
    out = run_client(
        controller.host,
        """
        from rtde_control import RTDEControlInterface
        c = RTDEControlInterface(host)
        try:
            RTDEControlInterface(host)
        except RuntimeError as error:
            out["error"] = str(error)
        """,
    )
    assert "in use" in out["error"]


def test_a_protective_stop_pauses_the_program_and_refuses_commands(
    controller: SimulatedController, bench: Bench
) -> None:
    out = run_client(
        controller.host,
        CONTROL
        + """
import socket
from dashboard_client import DashboardClient
d = DashboardClient(host)
d.connect()
b = socket.create_connection((host, 30100))
b.sendall(b"protective_stop\\n")
b.recv(10)
until(r.isProtectiveStopped)
out["bits"] = [r.isProtectiveStopped(), r.getSafetyMode(), r.getRuntimeState()]
until(lambda: not c.servoJ(q, 0.5, 0.5, 0.002, 0.1, 300))  # it has a connection of its own
out["servo"] = c.servoJ(q, 0.5, 0.5, 0.002, 0.1, 300)
out["move"] = c.moveJ([q[0] + 0.1] + q[1:], 1.0, 2.0)
try:
    d.unlockProtectiveStop()
except Exception as error:
    out["early"] = str(error)
def unlocked():
    try:
        d.unlockProtectiveStop()
    except RuntimeError:
        return False
    return True
until(unlocked)
until(lambda: not r.isProtectiveStopped())
out["released"] = [r.isProtectiveStopped(), r.getSafetyMode(), r.getRuntimeState()]
c.reuploadScript()
until(c.isProgramRunning)
out["again"] = c.moveJ([q[0] + 0.1] + q[1:], 1.0, 2.0)
""",
    )
    assert out["bits"] == [True, 3, 4]
    assert not out["servo"]
    assert not out["move"]
    assert "until 5s after" in out["early"]
    assert out["released"] == [False, 1, 4]
    assert out["again"]


def test_the_dashboard_client_gets_every_answer_it_looks_for(
    controller: SimulatedController,
) -> None:
    out = run_client(
        controller.host,
        """
        from dashboard_client import DashboardClient
        d = DashboardClient(host)
        d.connect()
        out["version"] = d.polyscopeVersion()
        out["serial"] = d.getSerialNumber()
        out["remote"] = d.isInRemoteControl()
        out["model"] = d.getRobotModel()
        out["texts"] = [d.robotmode(), d.safetymode(), d.safetystatus(), d.programState(),
            d.getLoadedProgram()]
        d.loadURP("weld.urp")
        d.play()
        until(d.running)
        out["playing"] = d.running()
        d.pause()
        out["paused"] = d.programState()
        d.play()
        d.stop()
        out["stopped"] = d.running()
        d.popup("hello"); d.closePopup(); d.closeSafetyPopup(); d.addToLog("note")
        d.powerOff()
        out["off"] = d.robotmode()
        try:
            d.play()
        except Exception as error:
            out["refused"] = str(error)
        d.powerOn(); d.brakeRelease()
        out["on"] = d.robotmode()
        d.quit()
        """,
    )
    assert out["version"] == "5.15.0.0"
    assert out["serial"].isdigit()
    assert out["remote"]
    assert out["model"] == "UR10"
    assert out["texts"] == [
        "Robotmode: RUNNING", "Safetymode: NORMAL", "Safetystatus: NORMAL", "STOPPED <unnamed>",
        "No program loaded",
    ]  # fmt: skip
    assert out["playing"]
    assert out["paused"] == "PAUSED weld.urp"
    assert not out["stopped"]
    assert out["off"] == "Robotmode: POWER_OFF"
    assert out["refused"] == "Failed to execute: play"
    assert out["on"] == "Robotmode: RUNNING"


def test_two_arms_move_side_by_side_on_their_own_addresses() -> None:
    one, two = cell_settings(seed=1), cell_settings(seed=2, arm="ur5e")
    with SimulatedController(one), SimulatedController(two):
        out = run_client(
            one.host,
            f"""
            from rtde_receive import RTDEReceiveInterface
            from rtde_control import RTDEControlInterface
            hosts = [host, {two.host!r}]
            r = [RTDEReceiveInterface(h) for h in hosts]
            c = [RTDEControlInterface(h) for h in hosts]
            q = [x.getActualQ() for x in r]
            for i in range(200):
                t = c[0].initPeriod()
                for k, sign in enumerate((1, -1)):
                    assert c[k].servoJ([q[k][0] + sign * 0.05 * i / 199] + q[k][1:],
                                       0.5, 0.5, 0.002, 0.05, 300)
                c[0].waitPeriod(t)
            until(lambda: abs(r[0].getActualQ()[0] - q[0][0] - 0.05) < 5e-7)
            until(lambda: abs(r[1].getActualQ()[0] - q[1][0] + 0.05) < 5e-7)
            out["moved"] = [x.getActualQ()[0] - y[0] for x, y in zip(r, q)]
            out["poses"] = [x.getActualTCPPose() for x in r]
            """,
        )
    assert out["moved"] == pytest.approx([0.05, -0.05], abs=1e-6)
    assert out["poses"][0] != out["poses"][1]
