"""An arm's driver joined with a sensor: wrenches, clocks, age, overload, and whose cycle it is."""

from __future__ import annotations

import termios
import threading
import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE, wait_for
from sensor_wires import (
    COG,
    KINDS,
    MASS,
    RESOLUTION,
    RPY,
    XYZ,
    Reaction,
    Wire,
    flange_rotation,
    make_wire,
    reaction_of,
    resting_controller,
    settings_of,
)

from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError, WriteError
from gapbridge.core.model import Model
from gapbridge.core.rotation import transform
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor import joined as joined_module
from gapbridge.drivers.ft_sensor.joined import LISTEN, DriverWithSensor, TcpForce
from gapbridge.drivers.ft_sensor.sensor import ClockOffset, ForceTorqueSensor, Reading
from gapbridge.drivers.simulated.server.arm_controller import ArmController

TURNED = (0.3, -1.2, 1.4, -1.1, -1.3, 0.8)  # rad
MOUNTED = {"sensor_in_flange": {"xyz": XYZ, "rpy": RPY}}
TOOL = transform(np.eye(3), np.array((0.0, 0.0, 0.18)))
PERIOD = 0.002  # s


class ControllerDriver(Driver):
    """An arm without a wire of its own: reads a simulated controller's plant, at 500 Hz."""

    def __init__(self, controller: ArmController, clock: Clock = SYSTEM) -> None:
        super().__init__(1.0 / PERIOD, Model(builtin_arm("ur10e")), clock=clock)
        self.controller = controller
        self.written: list[Setpoint] = []
        self.open = False
        self._due = 0.0

    def connect(self) -> None:
        self.open, self._due = True, time.monotonic()

    def _read_state(self) -> RobotState:
        time.sleep(max(self._due - time.monotonic(), 0.0))
        self._due = max(self._due + PERIOD, time.monotonic())
        now = time.monotonic()
        q, still = np.array(self.controller.q), np.zeros(self.n)
        return RobotState(now, now, q, still, q, np.full(6, 99.0))

    def _send(self, setpoint: Setpoint) -> None:
        self.written.append(setpoint)

    def close(self) -> None:
        self.open = False


class Standing(Clock):
    """A clock that stands: by it no sample is ever late, however busy the machine is."""

    def __init__(self) -> None:
        super().__init__()
        self.monotonic = lambda: 0.0


class ListedSensor(ForceTorqueSensor):
    """Gives the samples of a list, then waits: no wire, no time of its own."""

    def __init__(self, readings: list[Reading]) -> None:
        super().__init__(SYSTEM)
        self.left = deque(readings)
        self.emptied = threading.Event()

    def connect(self) -> None:
        pass

    def read(self, timeout: float) -> Reading | None:
        if self.left:
            return self.left.popleft()
        self.emptied.set()
        time.sleep(0.001)
        return None

    def close(self) -> None:
        pass


class BreakingSensor(ListedSensor):
    """Its link breaks with any error after the first sample, and works again once mended."""

    def __init__(self, error: Exception) -> None:
        super().__init__([Reading(0.0, 0.0, np.zeros(6))])
        self.error, self.opened, self.closed = error, 0, 0
        self.mended = threading.Event()

    def connect(self) -> None:
        self.opened += 1
        if self.opened > 1:
            assert self.mended.wait(PATIENCE)

    def read(self, timeout: float) -> Reading | None:
        if self.opened > 1:
            self.left.append(Reading(0.0, 0.0, np.ones(6)))
            time.sleep(0.001)
        if not self.left:
            raise self.error
        return super().read(timeout)

    def close(self) -> None:
        self.closed += 1


def model(**changed: Any) -> Model:
    return replace(
        Model(builtin_arm("ur10e"), TOOL, payload_mass=MASS, payload_cog=np.array(COG)), **changed
    )


def joined(
    wire: Wire, controller: ArmController, m: Model | None = None, **keys: Any
) -> DriverWithSensor:
    """Join an arm and a sensor; ``max_age`` counts only where a test names it."""
    settings = wire.settings(**{**MOUNTED, **keys})
    found = DriverWithSensor(ControllerDriver(controller), settings, m or model())
    if "max_age" not in keys:
        found._reader._clock = Standing()  # only its ages: arm and sensor go on
    return found


def bounds(kind: str, lever: float = 0.3) -> np.ndarray[Any, Any]:
    """Return what one count amounts to at the TCP."""
    force, torque = RESOLUTION[kind]
    return np.array(3 * (2 * force,) + 3 * (2 * torque + 2 * lever * force,))


@pytest.mark.parametrize("kind", KINDS)
def test_raw_wrench_and_tcp_force_are_the_plants(kind: str) -> None:
    controller = resting_controller(TURNED)
    wire = make_wire(kind, reaction_of(controller))
    pull = (12.0, -7.0, 20.0, 0.5, 1.0, -0.8)
    with wire.device, joined(wire, controller) as driver:
        state = driver.read_state()
        assert state.ft_raw_wrench is not None
        assert np.all(np.abs(state.ft_raw_wrench - controller.raw_wrench) <= bounds(kind))
        assert np.all(np.abs(state.actual_TCP_force) <= bounds(kind))  # nothing but the payload
        load = controller.plant.load
        controller.plant.load = replace(load, force=pull[:3], torque=pull[3:])
        controller.cycle()
        for _ in range(2000):  # what is on its way comes first
            state = driver.read_state()
            assert state.ft_raw_wrench is not None
            if np.all(np.abs(state.ft_raw_wrench - controller.raw_wrench) <= bounds(kind)):
                break
    assert np.all(np.abs(state.ft_raw_wrench - controller.raw_wrench) <= bounds(kind))
    assert np.all(np.abs(state.actual_TCP_force - pull) <= bounds(kind))
    rotation = flange_rotation(TURNED)
    down = rotation @ state.ft_raw_wrench[:3] - pull[:3]
    assert down == pytest.approx((0.0, 0.0, -MASS * 9.80665), abs=0.15)


def test_the_controllers_declared_payload_stands_instead_of_the_models() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    arm = ControllerDriver(controller)
    states = arm.read_state

    def declared() -> RobotState:
        return states()._replace(payload=MASS, payload_cog=np.array(COG))

    arm.read_state = declared  # type: ignore[method-assign]
    wrong = model(payload_mass=1.0)
    with wire.device, DriverWithSensor(arm, wire.settings(**MOUNTED), wrong) as driver:
        assert np.all(np.abs(driver.read_state().actual_TCP_force) <= bounds("robotous_rft"))


def test_a_load_in_the_effects_weighs_on_the_sensor_and_is_no_external_force() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    shift = (0.03, 0.01, -0.02)
    undeclared = model(
        payload_mass=MASS - 1.0,
        payload_cog=np.array(COG) - shift,
        terms=(Term("payload", Site(), (1.0,)), Term("payload_cog", Site(), shift)),
    )
    with wire.device, joined(wire, controller, undeclared) as driver:
        for _ in range(3):  # each cycle begins with what is declared
            assert np.all(np.abs(driver.read_state().actual_TCP_force) <= bounds("robotous_rft"))


def test_gravity_that_the_effects_turn_is_no_external_force() -> None:
    tilt = 0.05  # rad about x of base
    turned = model(terms=(Term("gravity_direction", Site(), (tilt, 0.0)),))
    gravity = 9.80665 * np.array((0.0, np.sin(tilt), -np.cos(tilt)))
    weight = MASS * flange_rotation(TURNED).T @ gravity
    reading = np.concatenate([weight, np.cross(COG, weight)])
    q = np.array(TURNED)
    state = RobotState(1.0, 0.0, q, np.zeros(6), q, np.zeros(6))
    assert TcpForce(turned).of(reading, state) == pytest.approx(np.zeros(6), abs=1e-9)


def test_an_arm_may_keep_its_own_tcp_force() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    with wire.device, joined(wire, controller, tcp_force="arm") as driver:
        state = driver.read_state()
    assert np.all(state.actual_TCP_force == 99.0)
    assert state.ft_raw_wrench is not None


def test_sensor_errors_in_the_model_are_undone_in_the_tcp_force_but_not_in_the_raw_wrench() -> None:
    controller = resting_controller(TURNED)
    bias = (2.0, -1.0, 3.0, 0.2, -0.1, 0.3)
    wire = make_wire(
        "robotous_rft",
        lambda: tuple(1.05 * v + b for v, b in zip(controller.raw_wrench, bias, strict=True)),
    )
    terms = (
        Term("ft_bias", Site(), bias),
        Term("ft_gain", Site(), (0.05,) * 6),
    )
    straight = {"sensor_in_flange": {"xyz": (0, 0, 0), "rpy": (0, 0, 0)}}
    with wire.device, joined(wire, controller, model(terms=terms), **straight) as driver:
        state = driver.read_state()
    assert state.ft_raw_wrench is not None
    expected = 1.05 * np.array(controller.raw_wrench) + bias
    assert np.all(np.abs(state.ft_raw_wrench - expected) <= bounds("robotous_rft"))
    assert np.all(np.abs(state.actual_TCP_force) <= bounds("robotous_rft"))


def test_a_stale_sensor_is_reported_while_the_arm_goes_on_and_its_return_heals() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("ati_netcanoem", reaction_of(controller))
    with wire.device, joined(wire, controller, max_age=0.08) as driver:
        heal(driver)
        wire.device.silent = True
        with pytest.raises(StaleStateError, match=r"ati_netcanoem.*ft_sensor\.max_age") as reported:
            read_for(driver, PATIENCE)
        assert "\n" not in str(reported.value)
        cycles = []
        for _ in range(50):
            begun = time.monotonic()
            with pytest.raises(StaleStateError):
                driver.read_state()
            cycles.append(time.monotonic() - begun)
        assert np.median(cycles) < LISTEN / 2  # the arm's cycle does not wait for the sensor
        wire.device.silent = False
        heal(driver)


def read_for(driver: DriverWithSensor, seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        driver.read_state()


def heal(driver: DriverWithSensor, limit: float = PATIENCE) -> RobotState:
    """Return the first state after a fault."""
    until = time.monotonic() + limit
    while True:
        try:
            return driver.read_state()
        except LinkError:
            assert time.monotonic() < until


def test_a_sensor_that_was_switched_off_and_on_comes_back() -> None:
    controller = resting_controller(TURNED)
    for kind in ("robotous_rft", "ati_netcanoem"):
        wire = make_wire(kind, reaction_of(controller))
        with wire.device, joined(wire, controller, max_age=1.0) as driver:
            wire.device.stop()
            with pytest.raises(StaleStateError):
                read_for(driver, PATIENCE)
            wire.device.start()
            heal(driver)


def test_a_cut_serial_line_is_reported_and_opened_anew(tmp_path: Any) -> None:
    from gapbridge.drivers.simulated.ft_sensor.ft300_device import Ft300Device

    controller, link = resting_controller(TURNED), tmp_path / "ft300"
    device, arm = Ft300Device(reaction_of(controller), SYSTEM, link), ControllerDriver(controller)
    settings = settings_of(
        driver="robotiq_ft300", port=str(link), max_age=1.0, when_lost="stop", **MOUNTED
    )
    with device, DriverWithSensor(arm, settings, model()) as driver:
        driver.read_state()
        device.stop()
        with pytest.raises(StaleStateError, match="ft300"):
            read_for(driver, PATIENCE)
        device.start()
        heal(driver)


@pytest.mark.parametrize(
    "error",
    [IndexError("index out of range"), RuntimeError(), termios.error(5, "Input/output error")],
)
def test_any_error_of_a_sensors_link_is_reported_and_the_link_opened_anew(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = BreakingSensor(error)
    monkeypatch.setattr(joined_module, "make_sensor", lambda *_: sensor)
    settings = settings_of(driver="ati_netcanoem", interface="virtual", channel="none")
    arm = ControllerDriver(resting_controller(TURNED), clock=Standing())
    with DriverWithSensor(arm, settings, model()) as driver:
        reader = driver._reader
        wait_for(lambda: sensor.opened == 2, "a second attempt")
        assert sensor.closed == 1
        assert type(error).__name__ in reader._why()
        sensor.mended.set()
        wait_for(lambda: bool(reader.at(0.0).wrench[0] == 1.0), "samples of the mended link")
        assert reader._why() == ""


def test_any_error_of_the_first_connection_is_a_link_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = ListedSensor([])

    def fail() -> None:
        raise IndexError("index out of range")

    monkeypatch.setattr(sensor, "connect", fail)
    monkeypatch.setattr(joined_module, "make_sensor", lambda *_: sensor)
    settings = settings_of(driver="ati_netcanoem", interface="virtual", channel="none")
    driver = DriverWithSensor(ControllerDriver(resting_controller(TURNED)), settings, model())
    with pytest.raises(LinkError, match="force-torque sensor: IndexError: index out of range"):
        driver.connect()


@pytest.mark.parametrize(
    ("limits", "phrase"),
    [({"force": 30.0}, r"force of 39\.\d N.*overload\.force"),
     ({"torque": 0.5}, r"torque of .* Nm.*overload\.torque")],
)  # fmt: skip
def test_more_than_the_sensor_may_carry_is_not_believed(
    limits: dict[str, float], phrase: str
) -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    driver = joined(wire, controller, overload=limits)
    with wire.device, driver, pytest.raises(InvalidStateError, match=phrase):
        driver.read_state()


def test_a_wrench_between_two_samples_is_believed_only_if_both_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples = [Reading(0.01 * k, 0.01 * k, np.zeros(6), status=int(k == 2)) for k in range(5)]
    sensor = ListedSensor(samples)
    monkeypatch.setattr(joined_module, "make_sensor", lambda *_: sensor)
    settings = settings_of(driver="ati_netcanoem", interface="virtual", channel="none")
    arm = ControllerDriver(resting_controller(TURNED), clock=Standing())
    with DriverWithSensor(arm, settings, model()) as driver:
        assert sensor.emptied.wait(PATIENCE)
        for moment in (0.015, 0.025):
            with pytest.raises(InvalidStateError):
                driver._reader.at(moment)
        for moment in (0.005, 0.035):
            assert np.all(driver._reader.at(moment).wrench == 0.0)


def test_the_sensors_own_overload_bits_are_not_believed_and_pass() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    with wire.device, joined(wire, controller) as driver:
        driver.read_state()
        wire.device.status = 0x20
        with pytest.raises(InvalidStateError, match="overload"):
            read_for(driver, PATIENCE)
        wire.device.status = 0
        heal(driver)


def test_no_sensor_is_a_link_error_and_the_arm_is_released() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", Reaction())
    wire.device.silent = True
    driver = joined(wire, controller, connect_timeout=0.2)
    with wire.device, pytest.raises(LinkError, match=r"ft_sensor\.connect_timeout"):
        driver.connect()
    assert isinstance(driver._arm, ControllerDriver)
    assert not driver._arm.open
    driver.close()


@pytest.mark.parametrize("lead", [0.0, 1234.5, -800.0])
def test_each_state_gets_the_wrench_of_its_own_moment_whatever_the_arms_clock_says(
    lead: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The load rises by 100 N/s: a wrench of another moment would show."""
    slope, step, delay = 100.0, 0.004, 0.0007
    taken = step * np.arange(60)
    sensor = ListedSensor(
        [Reading(t, t + delay, np.array((0.0, 0.0, slope * t, 0.0, 0.0, 0.0))) for t in taken]
    )
    monkeypatch.setattr(joined_module, "make_sensor", lambda *_: sensor)
    arm = ControllerDriver(resting_controller(TURNED), clock=Standing())
    settings = settings_of(driver="ati_netcanoem", interface="virtual", channel="none")
    moments = np.arange(0.011, taken[-1], PERIOD)
    late = np.random.default_rng(3).exponential(0.003, len(moments))  # s on the way, differently
    late[0] = 0.0  # the offset of the arm's clock is known from the first state on
    q = np.array(TURNED)
    states = iter(
        RobotState(t + lead, t + delay + more, q, np.zeros(6), q, np.zeros(6))
        for t, more in zip(moments, late, strict=True)
    )
    arm._read_state = lambda: next(states)  # type: ignore[method-assign]
    with DriverWithSensor(arm, settings, model()) as driver:
        assert sensor.emptied.wait(PATIENCE)
        for moment in moments:
            state = driver.read_state()
            assert state.ft_raw_wrench is not None
            # the arm's constant delay cannot be distinguished from an offset of its clock
            expected = slope * min(moment + delay, taken[-1])
            assert state.ft_raw_wrench[2] == pytest.approx(expected, abs=slope * 1e-4)


@pytest.mark.parametrize("jump", [-86400.0, -2.0, 86400.0])
def test_a_clock_that_was_set_is_followed_from_its_next_sample_on(jump: float) -> None:
    offset = ClockOffset()
    assert offset.take(100.0, 5.0) == 5.0
    assert offset.take(100.5, 5.52) == pytest.approx(5.5, abs=1e-4)
    assert offset.take(101.0 + jump, 6.0) == 6.0
    assert offset.take(101.1 + jump, 6.3) == pytest.approx(6.1, abs=1e-4)


def test_an_arm_is_not_armed_before_its_sensor_speaks() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    with wire.device, joined(wire, controller, connect_timeout=0.2) as driver:
        state = driver.read_state()
        wire.device.silent = True
        wait_for(lambda: not driver._reader.wait(0.2), "the end of what was on its way")
        with pytest.raises(WriteError, match=r"no sample of the sensor within 0\.2 s"):
            driver.arm(state)
        assert not driver._arm.gate._open


def test_setpoints_and_the_arms_own_wishes_pass_through() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    with wire.device, joined(wire, controller) as driver:
        state = driver.read_state()
        driver.arm(state)
        setpoint = Setpoint(state.target_q, state.target_q, np.zeros(6))
        driver.write_setpoint(setpoint)
        assert isinstance(driver._arm, ControllerDriver)
        assert driver._arm.written == [setpoint]
        assert np.array_equal(driver.nominal_q(state), state.target_q)
        assert (driver.rate, driver.n, driver.moves_arm) == (500.0, 6, True)
        driver.release()


class LapsingDriver(ControllerDriver):
    """An arm whose setpoints may become too old, as those that wait for a SYNC do."""

    lapsed = False

    def _take_lapsed(self) -> bool:
        lapsed, self.lapsed = self.lapsed, False
        return lapsed


def test_a_setpoint_of_the_arm_that_lapsed_is_taken_back_once() -> None:
    controller = resting_controller(TURNED)
    wire, arm = make_wire("robotous_rft", reaction_of(controller)), LapsingDriver(controller)
    with wire.device, DriverWithSensor(arm, wire.settings(**MOUNTED), model()) as driver:
        state = driver.read_state()
        driver.arm(state)
        q = state.target_q
        for way in (0.0, 0.001):
            driver.write_setpoint(Setpoint(q + way, q, np.zeros(6)), expiry=7.0)
        assert len(arm.written) == 2
        assert arm._expiry == 7.0
        assert not driver.take_lapsed()
        assert driver.gate._joints[2] == pytest.approx(q + 0.001, abs=1e-12)
        arm.lapsed = True
        assert driver.take_lapsed()
        assert driver.gate._joints[2] == pytest.approx(q, abs=1e-12), "as before the lapsed one"
        assert not driver.take_lapsed(), "once"
        driver.release()
        with pytest.raises(WriteError, match=r"arm\(\) first"):
            driver.write_setpoint(Setpoint(q, q, np.zeros(6)))
