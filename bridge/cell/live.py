"""A cell beside its controller: what the controller says of its arm, and where the cell differs."""

from __future__ import annotations

import time

from gapbridge.bridge.cell.cell import Cell
from gapbridge.bridge.cell.plausibility import Findings
from gapbridge.core.errors import CellError, InvalidStateError, StaleStateError
from gapbridge.core.state import RobotState
from gapbridge.drivers import make_driver
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ur_rtde.enquiry import require_listening
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

SAMPLES, LONGEST = 50, 2.0  # states, s
RATE = ("link", "rate")
SLOW = 0.8  # share of the rate asked for that must come


def live_findings(cell: Cell) -> Findings:
    """Return where a cell differs from its controller; observes, and moves nothing.

    Raises CellError for a cell without a link, LinkError where the controller cannot be read.
    """
    link = cell.link
    if link is None:
        raise CellError(f"{cell.path}: link: found nothing, expected the controller's address")
    if isinstance(link, UrRtdeSettings):
        require_listening(link.host)
    driver = make_driver(link, cell.model)
    errors: list[str] = []
    warnings: list[str] = []
    with driver:
        state = whole_state(driver)
        differences = list(driver.differences(state))
        for found in differences:
            text = f"{cell.path}, line {cell.document.line(found.keys)}: {found}"
            (errors if found.sure else warnings).append(text)
        if driver.mismatch() is not None and not errors:
            errors.append(f"{cell.path}: {driver.mismatch()}")
        rate = _rate(driver)
    if rate < SLOW * link.rate and not any(found.keys == RATE for found in differences):
        line = cell.document.line(RATE)
        warnings.append(
            f"{cell.path}, line {line}: link.rate: found {link.rate:g} Hz, expected about "
            f"{rate:.0f} Hz, as states come"
        )
    return Findings(errors, warnings)


def whole_state(driver: Driver) -> RobotState:
    """Return a state; a torn or missing sample is read again, for two seconds.

    Raises LinkError.
    """
    begun = time.monotonic()
    while True:
        try:
            return driver.read_state()
        except (InvalidStateError, StaleStateError):
            if time.monotonic() - begun > LONGEST:
                raise


def _rate(driver: Driver) -> float:
    """Return how often states come, Hz."""
    begun = time.monotonic()
    count = 0
    while count < SAMPLES and time.monotonic() - begun < LONGEST:
        whole_state(driver)
        count += 1
    return count / max(time.monotonic() - begun, 1e-6)
