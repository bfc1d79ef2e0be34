"""Comparison of a cell with its controller: arm, tool, payload, gravity and state rate."""

from __future__ import annotations

from gapbridge.bridge.cell.cell import Cell
from gapbridge.bridge.cell.plausibility import Findings
from gapbridge.core.errors import InvalidStateError, StaleStateError
from gapbridge.core.state import RobotState
from gapbridge.drivers import make_driver
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ur_rtde.enquiry import require_listening
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

RATE_SAMPLES, READ_TIMEOUT = 50, 2.0  # number of states, s
RATE_KEY = ("link", "rate")
MIN_RATE_SHARE = 0.8  # measured state rate / configured rate


def live_findings(cell: Cell, clock: Clock) -> Findings:
    """Return the differences of a cell from its controller; reads only, never moves the arm.

    Raises CellError for a cell without a link, LinkError if the controller cannot be read.
    """
    link = cell.link
    if link is None:
        raise cell.error(("link",), "found nothing, expected the controller's address")
    if isinstance(link, UrRtdeSettings):
        require_listening(link.host)
    driver = make_driver(link, cell.model, clock=clock)
    errors: list[str] = []
    warnings: list[str] = []
    with driver:
        state = read_valid_state(driver)
        differences = list(driver.differences(state))
        for difference in differences:
            text = f"{cell.path}, line {cell.document.line(difference.keys)}: {difference}"
            (errors if difference.sure else warnings).append(text)
        if driver.mismatch() is not None and not errors:
            errors.append(f"{cell.path}: {driver.mismatch()}")
        rate = _measured_rate(driver)
    if rate < MIN_RATE_SHARE * link.rate and not any(d.keys == RATE_KEY for d in differences):
        line = cell.document.line(RATE_KEY)
        warnings.append(
            f"{cell.path}, line {line}: link.rate: found {link.rate:g} Hz, expected about "
            f"{rate:.0f} Hz, the measured rate"
        )
    return Findings(errors, warnings)


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


def _measured_rate(driver: Driver) -> float:
    """Return the measured rate of states, Hz."""
    now = driver.clock.monotonic
    start = now()
    count = 0
    while count < RATE_SAMPLES and now() - start < READ_TIMEOUT:
        read_valid_state(driver)
        count += 1
    return count / max(now() - start, 1e-6)
