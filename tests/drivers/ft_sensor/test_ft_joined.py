"""An arm's driver joined with a sensor: wrenches, clocks, age, overload, and whose cycle it is."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE
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
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor.joined import DriverWithSensor
from gapbridge.drivers.simulated.server.arm_controller import ArmController

TURNED = (0.3, -1.2, 1.4, -1.1, -1.3, 0.8)  # rad
MOUNTED = {"sensor_in_flange": {"xyz": XYZ, "rpy": RPY}}
TOOL = transform(np.eye(3), np.array((0.0, 0.0, 0.18)))
PERIOD = 0.002  # s


class ControllerDriver(Driver):
    """An arm without a wire of its own: reads a simulated controller's plant, at 500 Hz."""

    def __init__(self, controller: ArmController, lead: float = 0.0) -> None:
        super().__init__(1.0 / PERIOD, Model(builtin_arm("ur10e")))
        self.controller, self.lead = (
            controller,
            lead,
        )  # lead: s of the arm's clock on this machine's
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
        return RobotState(now + self.lead, now, q, still, q, np.full(6, 99.0))

    def _send(self, setpoint: Setpoint) -> None:
        self.written.append(setpoint)

    def close(self) -> None:
        self.open = False


def model(**changed: Any) -> Model:
    return replace(
        Model(builtin_arm("ur10e"), TOOL, payload_mass=MASS, payload_cog=np.array(COG)), **changed
    )


def joined(
    wire: Wire, controller: ArmController, m: Model | None = None, **keys: Any
) -> DriverWithSensor:
    settings = wire.settings(**{**MOUNTED, **keys})
    return DriverWithSensor(
        ControllerDriver(controller, keys.pop("lead", 0.0)), settings, m or model()
    )


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
        driver.read_state()
        wire.device.silent = True
        begun = time.monotonic()
        with pytest.raises(StaleStateError, match=r"ati_netcanoem.*ft_sensor\.max_age") as reported:
            read_for(driver, 5.0)
        assert 0.05 < time.monotonic() - begun < 5.0
        assert "\n" not in str(reported.value)
        longest = 0.0
        for _ in range(50):  # the arm's cycle does not wait for the sensor
            before = time.monotonic()
            with pytest.raises(StaleStateError):
                driver.read_state()
            longest = max(longest, time.monotonic() - before)
        assert longest < 0.05
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
        with wire.device, joined(wire, controller) as driver:
            wire.device.stop()
            with pytest.raises(StaleStateError):
                read_for(driver, 20.0)
            wire.device.start()
            heal(driver)


def test_a_cut_serial_line_is_reported_and_opened_anew(tmp_path: Any) -> None:
    from gapbridge.drivers.simulated.ft_sensor.ft300_device import Ft300Device

    controller, link = resting_controller(TURNED), tmp_path / "ft300"
    device, arm = Ft300Device(reaction_of(controller), link), ControllerDriver(controller)
    settings = settings_of(
        driver="robotiq_ft300", port=str(link), max_age=1.0, when_lost="stop", **MOUNTED
    )
    with device, DriverWithSensor(arm, settings, model()) as driver:
        driver.read_state()
        device.stop()
        with pytest.raises(StaleStateError, match="ft300"):
            read_for(driver, 20.0)
        device.start()
        heal(driver)


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


def test_the_sensors_own_overload_bits_are_not_believed_and_pass() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    with wire.device, joined(wire, controller) as driver:
        driver.read_state()
        wire.device.status = 0x20
        time.sleep(0.05)
        with pytest.raises(InvalidStateError, match="overload"):
            driver.read_state()
        wire.device.status = 0
        time.sleep(0.05)
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
    lead: float,
) -> None:
    """The load rises by 100 N/s: a wrench of another moment would show."""
    begun = time.monotonic()
    slope = 100.0
    wire = make_wire("ati_netcanoem", lambda: (0, 0, slope * (time.monotonic() - begun), 0, 0, 0))
    controller = resting_controller(TURNED)
    straight = {"sensor_in_flange": {"xyz": (0, 0, 0), "rpy": (0, 0, 0)}}
    settings = wire.settings(**straight)
    gaps = []
    with (
        wire.device,
        DriverWithSensor(ControllerDriver(controller, lead), settings, model()) as driver,
    ):
        for _ in range(400):
            state = driver.read_state()
            assert state.ft_raw_wrench is not None
            felt_at = begun + state.ft_raw_wrench[2] / slope
            gaps.append(state.timestamp - lead - felt_at)
    # the sample before holds, so the wrench is half a sensor's period old on average
    assert -0.003 < np.median(gaps) < 0.006
    assert np.percentile(gaps, 95) < 0.02


def test_an_arm_is_not_armed_before_its_sensor_speaks() -> None:
    controller = resting_controller(TURNED)
    wire = make_wire("robotous_rft", reaction_of(controller))
    with wire.device, joined(wire, controller, connect_timeout=0.2) as driver:
        state = driver.read_state()
        wire.device.silent = True
        time.sleep(0.1)  # what was on its way has arrived
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
