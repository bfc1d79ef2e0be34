"""Comparison of a cell with its controller: arm, tool, payload, gravity and state rate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gapbridge.bridge.cell.cell import Cell
from gapbridge.core.arrays import Array
from gapbridge.core.errors import InvalidStateError, StaleStateError
from gapbridge.core.rotation import roll_pitch_yaw
from gapbridge.core.state import RobotState
from gapbridge.drivers import make_driver
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.controller_facts import ControllerFacts, flange_apart
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.rate_check import RateCheck
from gapbridge.drivers.ur_rtde.enquiry import require_listening
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

RATE_SAMPLES, READ_TIMEOUT = 50, 2.0  # number of states, s
RATE_KEY = ("link", "rate")
NOT_REPORTED = "not reported"
MIN_RATE_SHARE = 0.8  # measured state rate / configured rate


class Comparison(NamedTuple):
    """A cell beside its controller."""

    errors: list[str]  # lines that name file, line, key, what was found and what was expected
    warnings: list[str]
    table: list[str]  # lines: quantity, cell, controller


def compare_live(cell: Cell, clock: Clock) -> Comparison:
    """Return a cell beside its controller; reads only, never moves the arm.

    An error is what arming would refuse. Raises CellError for a cell without a link, LinkError if
    the controller cannot be read.
    """
    link = cell.link
    if link is None:
        raise cell.error(("link",), "found nothing, expected the controller's address")
    if isinstance(link, UrRtdeSettings):
        require_listening(link.host)
    driver = make_driver(link, cell.model, clock=clock)
    errors: list[str] = []
    warnings: list[str] = []
    check = RateCheck(driver.rate)
    with driver:
        state = read_valid_state(driver)
        facts, differences = driver.facts(state), driver.differences(state)
        mismatch = driver.mismatch()
        rate = _measured_rate(driver, check)
    if check.problem:
        differences = [d for d in differences if d.keys != RATE_KEY]
        errors.append(f"{cell.path}, line {cell.document.line(RATE_KEY)}: {check.problem}")
    for difference in differences:
        text = f"{cell.path}, line {cell.document.line(difference.keys)}: {difference}"
        (errors if difference.sure else warnings).append(text)
    if mismatch is not None and not errors:
        errors.append(f"{cell.path}: {mismatch}")
    known = check.problem or any(d.keys == RATE_KEY for d in differences)
    if rate < MIN_RATE_SHARE * link.rate and not known:
        line = cell.document.line(RATE_KEY)
        warnings.append(
            f"{cell.path}, line {line}: link.rate: found {link.rate:g} Hz, expected about "
            f"{rate:.0f} Hz, the measured rate"
        )
    return Comparison(errors, warnings, _table(cell, facts, rate))


def _table(cell: Cell, facts: ControllerFacts, rate: float) -> list[str]:
    """Return the lines of what a cell says and its controller reports; ``rate`` is measured, Hz."""
    model, tcp, apart = cell.model, facts.tcp, flange_apart(facts, cell.arm)
    ours = model.tool_in_flange
    reported = NOT_REPORTED if facts.rate is None else f"{facts.rate:g} Hz"
    rows = [
        ("quantity", "cell", "controller"),
        ("joints", str(cell.arm.n), str(facts.n)),
        ("TCP xyz", _text(ours[:3, 3], "m"), _text(None if tcp is None else tcp[:3, 3], "m")),
        ("TCP rpy", _text(roll_pitch_yaw(ours[:3, :3]), "rad"),
         _text(None if tcp is None else roll_pitch_yaw(tcp[:3, :3]), "rad")),
        ("payload", _text(model.payload_mass, "kg"), _text(facts.payload, "kg")),
        ("payload cog", _text(model.payload_cog, "m"), _text(facts.payload_cog, "m")),
        ("gravity", _text(model.gravity, "m/s2"), _text(facts.gravity, "m/s2")),
        ("calibration", "none" if cell.file.robot.calibration is None else "robot.calibration",
         NOT_REPORTED if apart is None else f"flange within {1e3 * apart:.2f} mm of the cell's"),
        ("rate", f"{cell.file.link.rate:g} Hz" if cell.file.link else "",
         f"{reported}, measured {rate:.0f} Hz"),
    ]  # fmt: skip
    widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
    return [f"{a:{widths[0]}}  {b:{widths[1]}}  {c}" for a, b, c in rows]


def _text(value: Array | float | None, unit: str) -> str:
    """Return a number or a vector with its unit, as the table shows it."""
    if value is None:
        return NOT_REPORTED
    numbers = [f"{round(float(v), 6) + 0.0:g}" for v in np.atleast_1d(value)]
    return f"{numbers[0] if np.ndim(value) == 0 else '[' + ', '.join(numbers) + ']'} {unit}"


def read_valid_state(driver: Driver) -> RobotState:
    """Return a valid state; retries an invalid or stale one for READ_TIMEOUT.

    Raises LinkError.
    """
    now = driver.clock.monotonic
    start = now()
    while True:
        try:
            return driver.read_state()
        except (InvalidStateError, StaleStateError):
            if now() - start > READ_TIMEOUT:
                raise


def _measured_rate(driver: Driver, check: RateCheck) -> float:
    """Return the rate of states by the controller's clock, Hz; ``check`` gets their timestamps."""
    now = driver.clock.monotonic
    start = now()
    times = [read_valid_state(driver).timestamp]
    while len(times) <= RATE_SAMPLES and now() - start < READ_TIMEOUT:
        times.append(read_valid_state(driver).timestamp)
    for time in times:
        check.take(time)
    return (len(times) - 1) / max(times[-1] - times[0], 1e-6)
