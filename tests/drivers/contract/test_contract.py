"""One contract for every driver and every profile, over its real wire."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from contract_case import Case
from contract_checks import (
    check_angles,
    check_closed,
    check_force,
    check_frozen,
    check_gate,
    check_joints,
    check_loss,
    check_not_armed,
    check_offset,
    check_reads,
    check_stall,
    check_torn,
    next_state,
)
from contract_table import CASES
from further import further
from patience import PATIENCE

from gapbridge.core.errors import WriteError
from gapbridge.drivers.can import driver as can
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.canopen import driver as canopen
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor import robotiq_ft300

TWICE = "canopen lwa4p, virtual"  # the same drives as over socketcand
PARAMS = [*(name for name in CASES if name != TWICE), *further(TWICE)]


@pytest.fixture(params=PARAMS)
def case(request: pytest.FixtureRequest) -> Iterator[Case]:
    with CASES[request.param]() as found:
        yield found


@pytest.fixture
def driver(case: Case, monkeypatch: pytest.MonkeyPatch) -> Iterator[Driver]:
    # controller and driver share this busy process: connecting may take longer than a cell allows
    monkeypatch.setattr(can, "FIRST_SAMPLE", PATIENCE)
    monkeypatch.setattr(canopen, "STARTING", PATIENCE)
    monkeypatch.setattr(robotiq_ft300, "TRIES", int(PATIENCE))
    with case.driver() as found:
        yield found


def test_states_are_complete_and_time_goes_on(case: Case, driver: Driver) -> None:
    check_reads(driver, case.model)


def test_angles_and_speeds_have_the_plants_units_and_signs(case: Case, driver: Driver) -> None:
    check_angles(case, driver)


def test_the_tcp_force_is_what_the_surroundings_apply(case: Case, driver: Driver) -> None:
    if case.force is None:
        assert not next_state(driver).actual_TCP_force.any()
        return
    check_force(case, driver)


def test_what_is_written_moves_the_plant(case: Case, driver: Driver) -> None:
    if case.writes is None:
        with pytest.raises(WriteError, match="read only"):
            driver.arm(next_state(driver))
        return
    assert driver.moves_arm == (case.writes == "joints")
    (check_joints if driver.moves_arm else check_offset)(case, driver)


def test_without_arming_nothing_leaves(case: Case, driver: Driver) -> None:
    before = np.array(case.controller.q)
    check_not_armed(driver)
    assert np.abs(before - case.controller.q).max() < 1e-9


def test_what_the_gate_refuses_never_reaches_the_plant(case: Case, driver: Driver) -> None:
    if case.writes is not None:
        check_gate(case, driver)


def test_silence_is_stale_in_time(case: Case, driver: Driver) -> None:
    check_stall(case, driver)


def test_a_clock_that_stands_still_is_stale(case: Case, driver: Driver) -> None:
    if not case.clocked:
        assert not case.clocked, "nothing but arrival shows a sample's age here"
        return
    check_frozen(case, driver)


def test_a_torn_sample_is_never_taken(case: Case, driver: Driver) -> None:
    check_torn(case, driver)


def test_a_controller_that_goes_away_is_reported_and_met_again(case: Case, driver: Driver) -> None:
    check_loss(case, driver)


def test_a_closed_driver_reads_nothing(driver: Driver) -> None:
    next_state(driver)
    check_closed(driver)


def test_a_question_that_nobody_has_heard_is_asked_again() -> None:
    with CASES["can openarm, socketcand"]() as case, case.driver() as driver:
        assert isinstance(driver, CanDriver)
        before, ask, lost = next_state(driver), driver.writer.request, [True]

        def request() -> None:
            if lost:
                lost.clear()
            else:
                ask()

        driver.writer.request = request  # type: ignore[method-assign]
        assert next_state(driver).timestamp > before.timestamp
        assert not lost
