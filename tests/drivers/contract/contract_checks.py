"""What every driver owes the loop; the same for a simulated controller and for real hardware."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from contract_case import PERIOD, Case
from patience import PATIENCE, wait_for

from gapbridge.core.errors import (
    GateError,
    InvalidStateError,
    LinkError,
    RobotBusyError,
    StaleStateError,
    WriteError,
)
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.plant.kinematics import gap, tcp_in_base
from gapbridge.drivers.simulated.server.arm_controller import ArmController

OFFSET = (4e-4, -3e-4, 5e-4, 2e-4, 0.0, -3e-4)  # m, rad: what a write of offsets moves the TCP by
STEP = 0.02  # rad: what a write of joints moves each joint by
PACE = 0.1  # rad/s


def next_state(driver: Driver, seconds: float = PATIENCE) -> RobotState:
    """Return the next believable state; torn ones, and late ones, may come before."""
    until = time.monotonic() + seconds
    while True:
        try:
            return driver.read_state()
        except (InvalidStateError, StaleStateError):
            assert time.monotonic() < until, "no believable state"


def read_on(driver: Driver, count: int = 1000) -> None:
    """Read states, torn ones too, until something breaks."""
    for _ in range(count):
        with contextlib.suppress(InvalidStateError):
            driver.read_state()


def check_reads(driver: Driver, model: Model, count: int = 8) -> list[RobotState]:
    """States are complete, finite, recent, and time goes on."""
    states, n = [], model.arm.n
    for _ in range(count):
        states.append(next_state(driver))
        assert time.monotonic() - states[-1].received < 5.0
    for state in states:
        assert state.actual_q.shape == state.actual_qd.shape == state.target_q.shape == (n,)
        assert state.actual_TCP_force.shape == (6,)
        for name in ("actual_q", "actual_qd", "target_q", "actual_TCP_force"):
            assert np.isfinite(getattr(state, name)).all(), name
        for name in ("joint_temperatures", "actual_current_as_torque"):
            found = getattr(state, name)
            assert found is None or (found.shape == (n,) and np.isfinite(found).all()), name
    times = np.diff([s.timestamp for s in states])
    assert (times > 0.0).all()
    assert (np.diff([s.received for s in states]) > 0.0).all()
    inside = model.arm.limits.lower - 0.1 <= states[-1].actual_q
    assert inside.all() and (states[-1].actual_q <= model.arm.limits.upper + 0.1).all()
    return states


def check_not_armed(driver: Driver) -> None:
    """A setpoint without arming is refused."""
    state = next_state(driver)
    q = driver.nominal_q(state)
    with pytest.raises(WriteError):
        driver.write_setpoint(setpoint_of(state, q, q, (0.0,) * 6))


def check_closed(driver: Driver) -> None:
    """A closed driver reads nothing, and closing it again is no fault."""
    driver.close()
    driver.close()
    with pytest.raises(LinkError):
        driver.read_state()


def check_angles(case: Case, driver: Driver) -> None:
    """Angles, speeds and their signs are the plant's, each joint on its own."""
    controller = case.controller
    start = controller.q
    goal = tuple(
        min(max(q + (0.1 + 0.02 * i) * (-1) ** i, lo + 0.01), hi - 0.01)
        for i, (q, lo, hi) in enumerate(
            zip(start, controller.plant.arm.lower, controller.plant.arm.upper, strict=True)
        )
    )
    until, fastest = time.monotonic() + PATIENCE, _fastest_on_the_way(case, driver, goal)
    while case.speed_resolution is not None and fastest <= 0.1:  # a busy machine has missed it
        assert time.monotonic() < until, "no speed was ever reported"
        _fastest_on_the_way(case, driver, start)
        fastest = _fastest_on_the_way(case, driver, goal)


def _fastest_on_the_way(case: Case, driver: Driver, goal: tuple[float, ...]) -> float:
    """Have the plant go to joints, and compare states with where it was; returns rad/s.

    A state is of one of the cycles since the motion began, however late it comes on a busy machine.
    """
    controller = case.controller
    fastest, until = 0.0, time.monotonic() + PATIENCE
    with _trace(controller) as cycles:
        controller.move_own(goal)
        while max(map(abs, controller.qd)) > 1e-6 or not np.allclose(controller.q, goal, atol=1e-6):
            assert time.monotonic() < until, "the plant never came there"
            state = next_state(driver)
            q, qd = np.moveaxis(np.array(cycles), 1, 0)
            near = case.resolution + 1e-3 + PERIOD * np.abs(qd).max()
            speeds = qd[np.abs(q - state.actual_q).max(axis=1) <= near]
            assert len(speeds), "the plant was never there"
            if case.speed_resolution is not None:
                close = np.abs(speeds - state.actual_qd) <= 0.1 + case.speed_resolution
                close &= (np.sign(speeds) == np.sign(state.actual_qd)) | (np.abs(speeds) < 0.05)
                assert close.all(axis=1).any(), "it never had these speeds there"
                fastest = max(fastest, float(np.abs(state.actual_qd).max()))
    wait_for(
        lambda: bool(np.abs(next_state(driver).actual_q - goal).max() <= case.resolution * 1.01),
        "the joints that the plant has come to",
    )  # fmt: skip
    return fastest


@contextlib.contextmanager
def _trace(
    controller: ArmController,
) -> Iterator[list[tuple[tuple[float, ...], tuple[float, ...]]]]:
    """Give the joints and speeds of every cycle of the plant from now on."""
    cycles = [(controller.q, controller.qd)]
    own = controller.cycle

    def cycle() -> None:
        own()
        cycles.append((controller.q, controller.qd))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(controller, "cycle", cycle)
        yield cycles


def check_force(case: Case, driver: Driver) -> None:
    """The force at the TCP is what the surroundings apply, in base axes."""
    load = case.controller.plant.load
    before = np.mean([next_state(driver).actual_TCP_force for _ in range(10)], axis=0)
    case.controller.plant.load = type(load)(load.mass, load.cog, (30.0, -50.0, 40.0), load.torque)
    settled = time.monotonic() + 0.5  # some controllers renew ten times a second
    while time.monotonic() < settled:
        next_state(driver)
    after = np.mean([next_state(driver).actual_TCP_force for _ in range(10)], axis=0)
    case.controller.plant.load = load
    assert (after - before)[:3] == pytest.approx((30.0, -50.0, 40.0), abs=1.5 + (case.force or 0.0))


def check_offset(case: Case, driver: Driver) -> None:
    """An offset moves the plant's TCP by just that, and goes again with its release."""
    controller = case.controller
    arm, tool = controller.plant.arm, controller.declared.tool
    bare = tcp_in_base(arm, controller.q, tool)

    def moved() -> list[float]:
        return list(gap(bare, tcp_in_base(arm, controller.q, tool)))

    driver.arm(next_state(driver))
    there = pytest.approx(OFFSET, abs=2e-6)
    stream(
        driver, lambda state, q: setpoint_of(state, q, q, OFFSET), 15.0, lambda: moved() == there
    )
    assert moved() == there
    stream(driver, lambda state, q: setpoint_of(state, q, q, OFFSET), 0.2)  # and no further
    assert (np.abs(moved()) <= np.abs(OFFSET) + 2e-6).all()
    stream(  # a busy machine may have let it go
        driver, lambda state, q: setpoint_of(state, q, q, OFFSET), 15.0, lambda: moved() == there
    )
    assert moved() == there
    nominal = driver.nominal_q(next_state(driver))
    assert np.abs(nominal - controller.own_q).max() <= case.resolution + 2e-5
    driver.release()
    wait_for(lambda: max(map(abs, moved())) < 2e-6, "the offset's end")


def check_joints(case: Case, driver: Driver) -> None:
    """Joint setpoints bring the plant there; after the release it stays."""
    controller = case.controller
    start = np.array(controller.q)
    sign = np.array([(-1.0) ** i for i in range(controller.n)])
    goal = start + STEP * sign
    begun = time.monotonic()
    driver.arm(next_state(driver))

    def setpoint(state: RobotState, _: np.ndarray) -> Setpoint:
        share = min((time.monotonic() - begun) * PACE / STEP, 1.0)
        q = start + share * (goal - start)
        return setpoint_of(state, q, q, (0.0,) * 6)

    stream(
        driver,
        setpoint,
        8.0,
        lambda: bool(np.abs(goal - controller.q).max() < case.resolution + 1e-4),
    )
    assert np.abs(goal - controller.q).max() < case.resolution + 1e-4
    driver.release()
    case.run_cycles(50)
    rest = np.array(controller.q)
    case.run_cycles(50)
    assert np.abs(rest - controller.q).max() < 1e-6
    assert np.abs(goal - controller.q).max() < case.resolution + 1e-3


def check_gate(case: Case, driver: Driver) -> None:
    """What is no number or far off never leaves, and the arm stays where it is."""
    before = np.array(case.controller.target_q)
    driver.arm(next_state(driver))
    state = next_state(driver)
    q = driver.nominal_q(state)
    nothing = (0.0,) * 6
    for bad in (np.nan, np.inf, 50.0):
        wrong = q.copy()
        wrong[-1] = bad
        setpoint = setpoint_of(state, q, q, nothing)._replace(q=wrong)
        with pytest.raises(GateError):
            driver.write_setpoint(setpoint)
    for length in (1.0, math.nan):
        with pytest.raises(GateError):
            driver.write_setpoint(setpoint_of(state, q, q, (length, *nothing[1:])))
    case.run_cycles(25)
    assert np.abs(before - case.controller.target_q).max() <= 2.0 * case.resolution + 1e-6
    write(driver, lambda state, q: setpoint_of(state, q, q, nothing))


def write(driver: Driver, setpoint: Callable[[RobotState, np.ndarray], Setpoint]) -> None:
    """Arm and write one setpoint; a busy machine may be later than the robot's watchdog."""

    def written() -> bool:
        state = next_state(driver)
        try:
            driver.write_setpoint(setpoint(state, driver.nominal_q(state)))
        except RobotBusyError:
            return False
        except WriteError:
            driver.release()
            with contextlib.suppress(WriteError):
                driver.arm(next_state(driver))
            return False
        return True

    wait_for(written, "a setpoint that is written")


def check_stall(case: Case, driver: Driver) -> None:
    """A controller that falls silent is stale in time, and is heard again afterwards.

    Meanwhile whoever asks again and again is kept waiting, and takes no core.
    """
    next_state(driver)
    case.controller.stall(2.0 * case.state_timeout + 0.3)
    begun = time.monotonic()
    with pytest.raises(StaleStateError):
        read_on(driver)
    stale = time.monotonic()
    assert stale - begun < 2.0 * case.state_timeout + 10.0
    asked = 0
    while time.monotonic() < stale + 0.1:
        with contextlib.suppress(StaleStateError, InvalidStateError):
            driver.read_state()
        asked += 1
    assert asked <= 0.1 * driver.rate + 3
    _recovers(driver)


def check_frozen(case: Case, driver: Driver) -> None:
    """A controller that answers while its clock stands still is stale."""
    next_state(driver)
    case.controller.frozen = True
    begun = time.monotonic()
    with pytest.raises(StaleStateError):
        read_on(driver)
    assert time.monotonic() - begun < 2.0 * case.state_timeout + 10.0
    case.controller.frozen = False
    _recovers(driver)


def check_torn(case: Case, driver: Driver) -> None:
    """A sample of two moments is noticed, and never taken for one."""
    for _ in range(3):
        last = next_state(driver)
    dropped = rounds = 0
    until = time.monotonic() + PATIENCE
    while rounds < 3 or not dropped:  # a busy machine may miss those of one round
        assert time.monotonic() < until, "no torn sample was ever read"
        rounds += 1
        case.tear()
        for _ in range(10):
            try:
                state = driver.read_state()
            except InvalidStateError:
                dropped += 1
                continue
            except StaleStateError:
                continue  # a busy machine
            if np.abs(state.actual_q - case.controller.q).max() > case.resolution + 1e-3:
                seconds = state.timestamp - last.timestamp
                assert seconds > case.torn_shows_within, (
                    f"a torn sample {seconds:g} s after a whole"
                )
                pytest.skip(f"this machine read no state for {seconds:.2f} s, and then a torn one")
            last = state


def check_loss(case: Case, driver: Driver) -> None:
    """A controller that goes away is a LinkError; when it is back, a driver connects again."""
    next_state(driver)
    case.stop()
    begun = time.monotonic()
    with pytest.raises(LinkError):
        read_on(driver)
    assert time.monotonic() - begun < case.state_timeout + 10.0
    driver.close()
    case.start()
    with case.driver() as again:
        check_reads(again, case.model, 3)


def stream(
    driver: Driver,
    setpoint: Callable[[RobotState, np.ndarray], Setpoint],
    seconds: float,
    done: Callable[[], bool] = lambda: False,
) -> None:
    """Write a setpoint for every state, for a while or until done."""
    until = time.monotonic() + seconds
    while time.monotonic() < until and not done():
        state = next_state(driver)
        with contextlib.suppress(RobotBusyError):  # from target to target
            driver.write_setpoint(setpoint(state, driver.nominal_q(state)))


def _recovers(driver: Driver) -> None:
    until = time.monotonic() + PATIENCE
    while True:
        try:
            driver.read_state()
        except (StaleStateError, InvalidStateError):
            assert time.monotonic() < until, "never heard again"
        else:
            return


def setpoint_of(
    state: RobotState, q: np.ndarray, nominal: np.ndarray, offset: tuple[float, ...]
) -> Setpoint:
    """Return a setpoint as the limiter hands it on."""
    assert all(map(math.isfinite, q))
    return Setpoint(q, nominal, np.array(offset))
