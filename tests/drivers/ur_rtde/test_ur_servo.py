"""Writing by servoJ: the plant follows, and whatever goes wrong is reported."""

from __future__ import annotations

import pytest
from driver_runs import Bench, run_driver
from simulated_controller import SimulatedController

ARMED = """
driver.connect()
first = driver.read_state()
driver.arm(first)
start = driver.read_state().target_q.copy()
def stream(cycles, goal):
    for k in range(cycles):
        state = driver.read_state()
        share = min((k + 1) / cycles, 1.0)
        q = start + share * (goal - start)
        driver.write_setpoint(setpoint(state, q, q))
    return state
"""


def run(host: str, body: str, **link: object) -> dict[str, object]:
    from textwrap import dedent

    return run_driver(host, ARMED + dedent(body), **link)


@pytest.mark.slow
def test_the_plant_follows_the_setpoints_and_stands_still_before(
    controller: SimulatedController, bench: Bench
) -> None:
    out = run(
        controller.host,
        """
        out["armed"] = (driver.read_state().target_q - first.target_q).tolist()
        goal = start + [0.05, -0.04, 0.03, 0.02, -0.01, 0.1]
        stream(500, goal)
        for _ in range(300):
            state = driver.read_state()
            driver.write_setpoint(setpoint(state, goal, goal))
        out["there"] = (state.actual_q - goal).tolist()
        out["truth"] = bench.truth()["rigid_tcp"]
        pose = model.rigid_pose(goal[None])
        out["wanted"] = pose.position[0].tolist()
        driver.release()
        state = read_for(100)
        out["rests"] = (state.target_q - goal).tolist()
        out["still"] = state.actual_qd.tolist()
        out["runtime"] = state.runtime_state
        """,
    )
    assert out["armed"] == pytest.approx([0] * 6, abs=1e-9)
    assert out["there"] == pytest.approx([0] * 6, abs=1e-3)
    assert out["truth"][:3] == pytest.approx(out["wanted"], abs=1e-3)  # type: ignore[index]
    assert out["rests"] == pytest.approx([0] * 6, abs=1e-3)
    assert out["still"] == pytest.approx([0] * 6, abs=1e-2)
    assert out["runtime"] == 1


@pytest.mark.slow
def test_arming_again_after_a_release_works(controller: SimulatedController) -> None:
    out = run(
        controller.host,
        """
        stream(50, start + 0.01)
        driver.release()
        state = read_for(50)
        driver.arm(state)
        start = driver.read_state().target_q.copy()
        stream(100, start + 0.01)
        out["moved"] = (driver.read_state().target_q - first.target_q).tolist()
        """,
    )
    assert out["moved"] == pytest.approx([0.02] * 6, abs=2e-3)


@pytest.mark.slow
def test_a_protective_stop_refuses_the_next_setpoint(controller: SimulatedController) -> None:
    out = run(
        controller.host,
        """
        stream(50, start + 0.01)
        bench.do("protective_stop")
        error, after = "", 0
        while not error and after < 100:
            state = driver.read_state()
            error, after = error_of(driver.write_setpoint, setpoint(state, start, start)), after + 1
        out["error"], out["after"] = error, after
        out["rearm"] = error_of(driver.arm, read_for(20))
        """,
    )
    assert str(out["error"]).startswith("WriteError: ")
    assert out["after"] < 50  # type: ignore[operator]
    assert "found robot_mode 7, safety_mode 3" in str(out["rearm"])


@pytest.mark.slow
def test_arming_after_a_protective_stop_does_not_go_to_the_target_of_before(
    controller: SimulatedController,
) -> None:
    out = run(
        controller.host,
        """
        import socket
        stream(50, start + 0.02)
        bench.do("protective_stop")
        while read_state().safety_mode != 3:
            pass
        error_of(driver.abandon)  # as the loop where it reads the stop before it writes again
        bench.do("unlock")
        with socket.create_connection((host, 29999), timeout=5) as dashboard:
            dashboard.sendall(b"stop\\n")
            while read_state().runtime_state != 1:
                pass
        bench.do("move " + " ".join(map(str, start - 0.1)))
        while np.abs(read_state().actual_q - start + 0.1).max() > 1e-3:
            pass
        driver.arm(read_for(20))
        state = read_for(100)
        out["away"] = (state.actual_q - start).tolist()
        out["still"] = float(np.abs(state.actual_qd).max())
        """,
    )
    assert out["away"] == pytest.approx([-0.1] * 6, abs=2e-3)
    assert out["still"] < 1e-2  # type: ignore[operator]


@pytest.mark.slow
def test_the_robots_watchdog_ends_the_stream_when_the_client_falls_silent(
    controller: SimulatedController,
) -> None:
    out = run(
        controller.host,
        """
        stream(100, start + 0.02)
        time.sleep(0.6)  # ten times longer than the watchdog allows
        state = read_for(20)
        out["runtime"] = state.runtime_state
        out["still"] = float(np.abs(state.actual_qd).max())
        out["error"] = error_of(driver.write_setpoint, setpoint(state, start, start))
        """,
        watchdog=20.0,
    )
    assert out["runtime"] == 1
    assert out["still"] < 1e-2  # type: ignore[operator]
    assert "WriteError" in str(out["error"])


@pytest.mark.slow
def test_setpoints_that_do_not_arrive_are_noticed(controller: SimulatedController) -> None:
    out = run(
        controller.host,
        """
        # the library's True, without its packet: what happens when its socket has gone
        class Deaf:
            def __init__(self, real): self.real = real
            def servoJ(self, *_): return True
            def __getattr__(self, name): return getattr(self.real, name)
        driver._writer._control = Deaf(driver._writer._control)
        error, begun = "", time.monotonic()
        while not error and time.monotonic() - begun < 3.0:
            state = driver.read_state()
            goal = start + min(time.monotonic() - begun, 1.0) * 0.3
            error = error_of(driver.write_setpoint, setpoint(state, goal, goal))
        out["error"], out["after"] = error, time.monotonic() - begun
        """,
    )
    assert "setpoints do not arrive" in str(out["error"])
    assert out["after"] < 2.0  # type: ignore[operator]


@pytest.mark.slow
def test_a_running_program_is_not_ended_by_arming(offset_robot: SimulatedController) -> None:
    out = run_driver(
        offset_robot.host,
        """
        driver.connect()
        out["error"] = error_of(driver.arm, read_for(20))
        out["runtime"] = read_for(50).runtime_state
        """,
    )
    assert "found a program running" in out["error"]
    assert out["runtime"] == 2


@pytest.mark.slow
def test_a_paused_program_is_not_ended_by_arming(offset_robot: SimulatedController) -> None:
    out = run_driver(
        offset_robot.host,
        """
        import socket
        driver.connect()
        with socket.create_connection((host, 29999), timeout=5) as dashboard:
            dashboard.sendall(b"pause\\n")
            while read_state().runtime_state != 4:
                pass
        out["error"] = error_of(driver.arm, read_state())
        out["runtime"] = read_for(50).runtime_state
        """,
    )
    assert "found a program paused" in out["error"]
    assert out["runtime"] == 4


@pytest.mark.slow
def test_writing_needs_arming_and_reading_first(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        from gapbridge.core.state import RobotState
        zero = np.zeros(6)
        blank = RobotState(0.0, 0.0, zero, zero, zero, zero)
        out["unread"] = error_of(driver.write_setpoint, setpoint(blank, zero, zero))
        driver.connect()
        state = driver.read_state()
        out["unarmed"] = error_of(driver.write_setpoint, setpoint(state, zero, zero))
        driver.close()
        """,
    )
    assert "expected arm() first" in out["unread"]
    assert "expected arm() first" in out["unarmed"]


@pytest.mark.slow
def test_a_robot_that_another_client_controls_is_refused_in_one_line(
    controller: SimulatedController,
) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        driver.arm(driver.read_state())
        driver._writer._control.stopScript()
        state = read_for(50)
        other = make_driver(UrRtdeSettings(host=host, remote_control=False), model)
        other.connect()
        out["error"] = error_of(other.arm, other.read_state())
        """,
    )
    assert out["error"].startswith("WriteError: ")
    assert "in use" in out["error"]
    assert "\n" not in out["error"]


@pytest.mark.slow
@pytest.mark.realtime
def test_an_emergency_stop_ends_the_stream_and_arming_is_refused(
    controller: SimulatedController,
) -> None:
    out = run(
        controller.host,
        """
        stream(30, start + 0.005)
        bench.do("emergency_stop")
        error, after = "", 0
        while not error and after < 200:
            state, after = driver.read_state(), after + 1
            error = error_of(driver.write_setpoint, setpoint(state, start, start))
        out["error"] = error
        out["rearm"] = error_of(driver.arm, read_for(20))
        driver.close()
        driver.close()
        """,
    )
    assert str(out["error"]).startswith("WriteError: ")
    assert "expected robot_mode 7 (running)" in str(out["rearm"])
