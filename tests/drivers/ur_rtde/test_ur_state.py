"""Reading: what the driver says of the plant, and what it refuses to believe."""

from __future__ import annotations

import pytest
from driver_runs import run_driver
from simulated_controller import SimulatedController

from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings


@pytest.mark.slow
def test_a_state_is_the_plants(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        with driver:
            states = [read_state() for _ in range(200)]
            free = np.mean([s.actual_TCP_force for s in states], axis=0)
            bench.do("wrench 30 -20 10 1 2 -3")
            read_for(50)
            pulled = np.mean([read_state().actual_TCP_force for _ in range(200)], axis=0)
            out["pull"] = (pulled - free).tolist()
            s = states[-1]
            out["q"] = s.actual_q.tolist()
            out["target"] = s.target_q.tolist()
            out["sizes"] = [len(s.actual_qd), len(s.ft_raw_wrench), len(s.joint_temperatures)]
            out["temperature"] = s.joint_temperatures.tolist()
            out["declared"] = [s.payload, *s.payload_cog]
            out["modes"] = [s.robot_mode, s.safety_mode, s.runtime_state, s.safety_status_bits]
            out["gaps"] = np.diff([s.timestamp for s in states]).tolist()
            out["torque"] = s.actual_current_as_torque is None
            out["scaling"] = s.speed_scaling
            out["tcp"] = driver.reader.joints_and_tcp()[1].tolist()
            out["age"] = min(
                -read_state().received + time.monotonic() for _ in range(50)
            )
            from gapbridge.core.rotation import rotation_vector
            pose = model.rigid_pose(s.actual_q[None])
            out["model"] = [*pose.position[0], *rotation_vector(pose.rotation[0])]
        """,
    )
    start = controller.settings.start_q
    assert out["q"] == pytest.approx(start, abs=2e-4)
    assert out["target"] == pytest.approx(start, abs=1e-9)
    assert out["pull"][:3] == pytest.approx([30, -20, 10], abs=0.3)
    assert out["pull"][3:] == pytest.approx([1, 2, -3], abs=0.3)
    assert out["sizes"] == [6, 6, 6]
    assert all(15 < t < 60 for t in out["temperature"])
    assert out["declared"] == [0.0, 0.0, 0.0, 0.0]
    assert out["modes"] == [7, 1, 1, 1]
    assert min(out["gaps"]) > 0
    assert sum(g < 0.0021 for g in out["gaps"]) > 150
    assert out["torque"]
    assert out["scaling"] == pytest.approx(1.0)
    assert out["tcp"][:3] == pytest.approx(out["model"][:3], abs=2e-3)
    assert 0 <= out["age"] < 0.01


@pytest.mark.slow
def test_reading_claims_and_writes_nothing(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        first = driver.read_state()
        import rtde_control
        control = rtde_control.RTDEControlInterface(host)  # would be refused were an input claimed
        out["control"] = control.isConnected()
        out["runtime"] = first.runtime_state
        """,
    )
    assert out == {"control": True, "runtime": 1}


@pytest.mark.slow
def test_a_frozen_clock_is_stale_in_time_although_packets_flow(
    controller: SimulatedController,
) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        read_for(50)
        bench.do("freeze")
        out["error"], out["after"] = until_error(2.0)
        out["connected"] = driver.reader._receive.isConnected()
        bench.do("thaw")
        begun = time.monotonic()
        while error_of(driver.read_state) and time.monotonic() - begun < 5.0:
            time.sleep(0.01)
        out["again"] = error_of(driver.read_state)
        """,
        state_timeout=0.05,
    )
    assert out["error"].startswith("StaleStateError: ")
    assert 0.04 < out["after"] < 0.5
    assert out["connected"]  # which is why nobody asks it
    assert out["again"] == ""


@pytest.mark.slow
def test_a_stalled_and_a_dropped_link_are_stale(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        read_for(20)
        bench.do("stall 1.2")
        out["stalled"], out["after"] = until_error(2.0)
        begun, out["asked"] = time.monotonic(), 0
        while time.monotonic() < begun + 0.2:  # who asks again is kept waiting for a cycle
            error_of(driver.read_state)
            out["asked"] += 1
        time.sleep(1.0)
        read_for(20)
        bench.do("drop")
        out["dropped"], _ = until_error(2.0)
        """,
        state_timeout=0.1,
    )
    assert out["stalled"].startswith("StaleStateError: ")
    assert out["asked"] <= 0.2 * 500 + 2
    assert out["after"] < 0.7
    assert out["dropped"].startswith("StaleStateError: ")


def test_a_controller_that_is_not_there_is_one_line() -> None:
    out = _nobody()
    assert out["error"].startswith("LinkError: could not connect to 127.250.250.250, port 30004")
    assert "\n" not in out["error"]
    assert "expected connect() first" in out["unread"]


def _nobody() -> dict[str, str]:
    from simulated_cell import run_client

    return run_client(
        "127.250.250.250",
        """
        from gapbridge.core.arm import builtin_arm
        from gapbridge.core.errors import LinkError
        from gapbridge.core.model import Model
        from gapbridge.drivers import make_driver
        from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings
        driver = make_driver(UrRtdeSettings(host=host), Model(builtin_arm("ur10e")))
        for name, action in (("error", driver.connect), ("unread", driver.read_state)):
            try:
                action()
            except LinkError as error:
                out[name] = "LinkError: " + str(error)
        driver.close()
        driver.close()
        """,
    )


@pytest.mark.slow
def test_a_sample_that_is_torn_by_a_packet_is_read_again(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        read_for(20)
        reader = driver.reader
        quick, packets = reader._getters[0], [1]
        def slow():  # so slow that packets come meanwhile
            values = quick()
            before = reader._receive.getTimestamp()
            while packets and reader._receive.getTimestamp() == before:
                time.sleep(0.0005)
            if packets:
                packets.pop()
            return values
        reader._getters[0] = slow
        before = reader.torn
        state = driver.read_state()
        out["torn"] = reader.torn - before
        out["fresh"] = state.timestamp == reader._last
        packets[:] = [1] * 10
        out["hopeless"] = error_of(driver.read_state)
        packets.clear()
        reader._getters[0] = quick
        out["again"] = error_of(driver.read_state)
        """,
    )
    assert out["torn"] >= 1
    assert out["fresh"]
    assert out["hopeless"].startswith("InvalidStateError: ")
    assert out["again"] == ""


@pytest.mark.slow
def test_states_that_cannot_be_are_refused_and_the_next_is_read(
    controller: SimulatedController,
) -> None:
    wrong = {
        "[0.0, -1.5, math.nan, -1.87, -1.57, 0.0]": "actual_q_2: found nan",
        "[0.0, -1.5, 1.8, math.inf, -1.57, 0.0]": "actual_q_3: found inf",
        "[0.0, -1.5, 1.8]": "actual_q: found 3 numbers, expected 6",
        "[]": "actual_q: found 0 numbers, expected 6",
        "[0.0, -1.5, 1.8, 900.0, -1.57, 0.0]": "actual_q_3: found 900",
        "[0.0, -1.5, 1.8, -1.87, -1.57, 0.5]": "actual_q_5: found a step of 0.5",
    }
    out = run_driver(
        controller.host,
        f"""
        driver.connect()
        read_for(20)
        real = driver.reader._getters[0]
        assert driver.reader._fields[0][0] == "actual_q"
        for values in {list(wrong)!r}:
            driver.reader._getters[0] = lambda: eval(values)
            out[values] = error_of(driver.read_state)
            driver.reader._getters[0] = real
            read_for(3)
        """,
    )
    for values, message in wrong.items():
        assert out[values].startswith("InvalidStateError: ")
        assert message in out[values]


@pytest.mark.slow
def test_a_restarted_controller_is_noticed_by_its_clock(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        read_for(20)
        driver._check._timestamp += 1000.0
        out["error"] = error_of(driver.read_state)
        """,
    )
    assert "clock went back" in out["error"]


@pytest.mark.slow
def test_torques_need_the_motors_constants(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        receive = driver.reader._receive
        for _ in range(1000):  # until both are of one sample
            s, current = read_state(), receive.getActualCurrent()
            if receive.getTimestamp() == s.timestamp:
                break
        out["torque"], out["current"] = s.actual_current_as_torque.tolist(), current
        """,
        torque_constants=(10.0, 11.0, 12.0, 13.0, 14.0, 15.0),
    )
    assert len(out["torque"]) == 6
    for torque, current, constant in zip(out["torque"], out["current"], range(10, 16), strict=True):
        assert torque == pytest.approx(current * constant, abs=1e-9)
    assert any(abs(t) > 1e-3 for t in out["torque"])


@pytest.mark.parametrize("host", ["", "127.0.0.2:30004", "::1", " 127.0.0.2"])
def test_hosts_that_the_library_cannot_reach_are_refused(host: str) -> None:
    with pytest.raises(ValueError, match="without a port"):
        UrRtdeSettings(host=host)
