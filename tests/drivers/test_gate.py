"""The gate: what no driver's write passes, whatever computed it."""

from __future__ import annotations

import inspect
import time
from typing import Any

import numpy as np
import pytest
from test_drivers import WIRED, link

from gapbridge.bridge.cell.sections import LimitSettings
from gapbridge.bridge.loop.setpoint_stream import gate_bounds, limits_of
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import GateError, WriteError
from gapbridge.core.limits import Limiter
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers import DRIVERS, gate, make_driver
from gapbridge.drivers.driver import GATED, Driver
from gapbridge.drivers.gate import Gate, GateBounds

Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
RATE = 500.0
TOOL = np.eye(4)
TOOL[2, 3] = 0.18
MODEL = Model(builtin_arm("ur10e"), TOOL)
NOTHING = np.zeros(6)


class Clock:
    now = 10.0

    def __call__(self) -> float:
        return self.now


def opened(moves_arm: bool, bounds: GateBounds | None = None) -> tuple[Gate, Clock]:
    clock = Clock()
    found = Gate(RATE, MODEL, moves_arm, clock)
    found.set_bounds(bounds or GateBounds())
    found.begin(Q, Q)
    return found, clock


def setpoint(q: Any = Q, nominal: Any = Q, offset: Any = NOTHING) -> Setpoint:
    return Setpoint(np.asarray(q), np.asarray(nominal), np.asarray(offset))


def along_x(metres: float) -> np.ndarray:
    return np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0])


def spoilt(joint: int, value: float) -> np.ndarray:
    found = Q.copy()
    found[joint] = value
    return found


BAD = {
    "NaN in the joints": setpoint(q=spoilt(2, np.nan)),
    "NaN in the nominal joints": setpoint(nominal=spoilt(2, np.nan)),
    "NaN in the offset": setpoint(offset=along_x(np.nan)),
    "inf in the joints": setpoint(q=spoilt(5, np.inf)),
    "inf in the offset": setpoint(offset=along_x(-np.inf)),
    "50 rad": setpoint(q=spoilt(0, 50.0), nominal=spoilt(0, 50.0)),
    "an offset of 1.0 m": setpoint(offset=along_x(1.0)),
    "joints at once 0.3 rad away": setpoint(q=Q + 0.3, nominal=Q + 0.3),
    "five joints": setpoint(q=Q[:5]),
    "one number for all joints": setpoint(q=Q[:1]),
}


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("name", WIRED)
def test_no_driver_sends_what_its_gate_refuses(
    name: str, bad: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Model(builtin_arm("ur10e"))
    driver = make_driver(link(name, host="127.255.255.254"), model)
    sent: list[Setpoint] = []
    monkeypatch.setattr(driver, "_send", sent.append)
    driver.gate.begin(Q, Q)
    if not driver.moves_arm and bad.startswith("joints at once"):
        return  # the robot's own program moves the arm, as it likes
    with pytest.raises(GateError):
        driver.write_setpoint(BAD[bad])
    assert sent == []
    driver.write_setpoint(setpoint())
    assert len(sent) == 1


@pytest.mark.parametrize("name", WIRED)
def test_no_driver_writes_before_it_is_armed_or_after_it_was_released(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = make_driver(link(name, host="127.255.255.254"), Model(builtin_arm("ur10e")))
    for hook in ("_send", "_make_ready"):
        monkeypatch.setattr(driver, hook, lambda _: None)
    monkeypatch.setattr(driver, "_release", lambda: None)
    monkeypatch.setattr(driver, "differences", lambda _: [])  # nobody is there to be asked
    state = RobotState(1.0, 0.0, Q, NOTHING, Q, NOTHING)
    with pytest.raises(WriteError, match="expected arm"):
        driver.write_setpoint(setpoint())
    driver.arm(state)
    driver.write_setpoint(setpoint())
    driver.release()
    with pytest.raises(WriteError, match="expected arm"):
        driver.write_setpoint(setpoint())


@pytest.mark.parametrize("name", GATED)
def test_a_new_driver_cannot_go_around_the_gate(name: str) -> None:
    with pytest.raises(TypeError, match=f"{name}: found a driver's own"):
        type("Sly", (Driver,), {name: lambda *_: None})


def test_every_driver_of_the_table_has_its_write_from_the_base() -> None:
    import importlib

    for place in DRIVERS.values():
        module, kind = place.split(":")
        found = getattr(importlib.import_module(module), kind)
        for name in GATED:
            assert inspect.getattr_static(found, name) is Driver.__dict__[name]


def test_the_gate_shares_nothing_with_the_limiter() -> None:
    source = inspect.getsource(gate)
    assert "gapbridge.core.limits" not in source.split('"""', 2)[2]
    assert "compensation" not in source


def test_the_default_bounds_are_those_of_a_cell() -> None:
    assert gate_bounds(LimitSettings()) == GateBounds()


def test_offsets_are_judged_by_envelope_step_and_rate() -> None:
    found, clock = opened(moves_arm=False)
    most = 0.05 * 5.0 / RATE
    with pytest.raises(GateError, match="step that takes"):
        found.check(setpoint(offset=along_x(1.01 * most)))
    at, steps, reasons = 0.0, 0, set()
    for _ in range(1000):  # to and fro by five cycles' step in every cycle, inside the envelope
        try:
            found.check(setpoint(offset=along_x(most - at)))
        except GateError as error:
            reasons.add(str(error).rpartition(", ")[2])
        else:
            found.sent()
            at, steps = most - at, steps + 1
        clock.now += 1.0 / RATE
    allowed = 1.02 * 1000 / RATE + 5.0 / RATE + max(0.04, 5.0 / RATE)  # s of travel
    assert 150 < steps <= allowed * RATE / 5.0
    assert reasons == {"more than has passed"}
    found, clock = opened(moves_arm=False)
    for k in range(1, 100):  # as fast as the cell allows
        found.check(setpoint(offset=along_x(0.05 * k / RATE)))
        found.sent()
        clock.now += 1.0 / RATE
    with pytest.raises(GateError, match="step"):  # a zero is a step as any other
        found.check(setpoint())


@pytest.mark.parametrize("axis", [0, 4])
def test_no_number_of_small_steps_leaves_the_envelope_of_offsets(axis: int) -> None:
    found, clock = opened(moves_arm=False)
    bounds = GateBounds()
    rate, most = (0.05, bounds.offset) if axis < 3 else (0.1, bounds.offset_rotation)
    reached = []

    def walk() -> None:
        for k in range(1, int(20 * RATE)):
            offset = np.zeros(6)
            offset[axis] = rate * k / RATE
            found.check(setpoint(offset=offset))
            found.sent()
            reached.append(offset[axis])
            clock.now += 1.0 / RATE

    with pytest.raises(GateError, match="offset"):
        walk()
    assert most - rate / RATE < reached[-1] <= most * (1 + 1e-6)


def test_the_envelope_of_joints_is_where_they_bring_the_tcp() -> None:
    found, _ = opened(moves_arm=True, bounds=GateBounds(joint_offset=0.5))
    q = spoilt(0, Q[0] + 0.02)  # 0.7 m from the first joint's axis: 14 mm
    found.check(setpoint())
    found.sent()
    with pytest.raises(GateError, match=r"an offset of 0\.01\d+ m, expected at most 0\.01"):
        found.check(setpoint(q=q))
    found.check(setpoint(q=q, nominal=q))


def test_a_command_that_its_joints_speed_holds_back_may_only_come_nearer() -> None:
    found, clock = opened(moves_arm=True)
    nominal = Q + 0.1
    found.check(setpoint(q=Q, nominal=nominal))
    found.sent()
    clock.now += 0.01
    with pytest.raises(GateError, match="from its nominal setpoint"):
        found.check(setpoint(q=Q - 0.005, nominal=nominal))
    found.check(setpoint(q=Q + 0.005, nominal=nominal))
    found.sent()


def test_a_first_setpoint_is_within_the_envelope_of_its_nominal_joints() -> None:
    gate, _ = opened(moves_arm=True, bounds=GateBounds(offset=0.002))
    far = Q + np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])  # near the arm, some 20 mm from nominal
    with pytest.raises(GateError, match=r"found an offset of 0\.0[1-9]"):
        gate.check(setpoint(far))
    gate.check(setpoint(Q + np.array([0.0, 0.001, 0.0, 0.0, 0.0, 0.0])))


def test_a_first_setpoint_away_from_the_arm_is_refused() -> None:
    found, _ = opened(moves_arm=True)
    with pytest.raises(GateError, match=r"joint 3: found a first setpoint 0\.0600 rad"):
        found.check(setpoint(q=spoilt(2, Q[2] + 0.06), nominal=spoilt(2, Q[2] + 0.06)))


def test_the_limiter_at_its_limits_passes_the_gate() -> None:
    """What the limiter lets out the gate lets through: at the rate, in the envelope, in lag."""
    settings = LimitSettings(offset=0.004)
    limits = limits_of(settings, MODEL.arm, RATE)
    limiter, (found, clock) = Limiter(limits, 6), opened(True, gate_bounds(settings))
    random = np.random.default_rng(7)
    limiter.start(Q)
    nominal, speed = Q.copy(), np.zeros(6)
    for _ in range(3000):
        speed = np.clip(speed + random.normal(0.0, 0.3, 6), -1.9, 1.9)
        speed[nominal > Q + 0.5], speed[nominal < Q - 0.5] = -1.0, 1.0
        nominal = nominal + speed / RATE
        delta = random.normal(0.0, 0.01, 6)
        moved = MODEL.rigid_pose(np.stack([nominal, nominal + delta])).position
        offset = np.concatenate([moved[1] - moved[0], delta[3:]])
        try:
            limited = limiter.limit(nominal, nominal + delta, offset, 1.0, nominal, 1.0 / RATE)
        except Exception:  # what the limiter refuses needs no gate
            limiter.start(nominal)
            found.begin(nominal)
            continue
        found.check(Setpoint(limited.q, nominal, limited.offset_in_base))
        found.sent()
        clock.now += 1.0 / RATE


def test_what_the_limiter_hands_out_cannot_be_written() -> None:
    limiter = Limiter(limits_of(LimitSettings(), MODEL.arm, RATE), 6)
    limiter.start(Q)
    found = limiter.limit(Q, Q, NOTHING, 1.0, Q, 1.0 / RATE)
    for array in (found.q, found.offset_in_base, limiter.joint_offset):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 50.0


def test_the_gate_costs_a_small_part_of_a_cycle() -> None:
    found, _ = opened(moves_arm=True)
    good = setpoint(q=Q + 1e-4)
    best = np.inf
    for _ in range(20):
        begun = time.perf_counter()
        for _ in range(100):
            found.check(good)
            found.sent()
        best = min(best, (time.perf_counter() - begun) / 100)
    assert best < 0.02 / RATE  # two percent
