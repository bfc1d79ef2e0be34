"""What every driver of the table must be, without any hardware."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
from link_settings import link_settings

from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.errors import LinkError
from gapbridge.core.model import Model
from gapbridge.drivers import DRIVERS, make_driver
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.link_settings import DriverSettings


@pytest.fixture
def model() -> Model:
    return Model(builtin_arm("ur5e"))


WIRED = [name for name in DRIVERS if name != "replay"]
"""Drivers with a controller at the other end; a recording has tests of its own."""

KEYS: dict[str, dict[str, Any]] = {
    "can": {"profile": "piper", "interface": "socketcand", "channel": "can0", "port": 29536},
    "canopen": {
        "profile": "lwa4p", "interface": "socketcand", "channel": "can0", "port": 29536,
    },
    "modbus": {"profile": "ur"},
}  # fmt: skip
"""What a link of a driver must say beside its name and its host."""


def link(name: str = "ur_rtde", **keys: Any) -> DriverSettings:
    return link_settings(driver=name, **KEYS.get(name, {}), **keys)


@pytest.mark.parametrize("name", WIRED)
def test_a_driver_is_made_without_touching_hardware(name: str, model: Model) -> None:
    settings = link(name, host="127.255.255.254")
    driver = make_driver(settings, model)
    assert isinstance(driver, Driver)
    assert driver.n == model.arm.n
    assert driver.rate == settings.rate
    driver.close()  # also without connect, and again
    driver.close()


@pytest.mark.parametrize("name", WIRED)
def test_a_driver_goes_by_the_clock_that_it_is_given(name: str, model: Model) -> None:
    clock = Clock()
    assert make_driver(link(name), model, clock=clock).clock is clock


@pytest.mark.parametrize("name", WIRED)
def test_a_controller_that_is_not_there_is_a_link_error(name: str, model: Model) -> None:
    driver = make_driver(link(name, host="127.255.255.254"), model)
    with pytest.raises(LinkError, match=r"127\.255\.255\.254"):
        driver.connect()


@pytest.mark.parametrize("name", WIRED)
def test_reading_before_connecting_is_refused(name: str, model: Model) -> None:
    driver = make_driver(link(name), model)
    with pytest.raises(LinkError):
        driver.read_state()


def test_an_unknown_driver_is_reported_with_those_that_exist(model: Model) -> None:
    class Other(DriverSettings):
        driver: str = "telepathy"

    with pytest.raises(LinkError, match=r"found .telepathy., expected one of .*ur_rtde"):
        make_driver(Other(), model)


def test_a_library_that_is_missing_is_reported(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(DRIVERS, "ur_rtde", "gapbridge.drivers.nowhere:Nothing")
    with pytest.raises(LinkError, match="its library cannot be imported"):
        make_driver(link(), model)


def test_a_ur_has_six_joints(model: Model) -> None:
    arm = model.arm
    seven = Arm(
        "seven", arm.link_in_link[[0, 1, 2, 3, 4, 5, 5, 6]], *(_grown(v) for v in _rows(arm)),
        limits=type(arm.limits).none(7),
    )  # fmt: skip
    with pytest.raises(LinkError, match="7 joints"):
        make_driver(link(), Model(seven))


def _rows(arm: Arm) -> tuple[Any, ...]:
    return arm.mass, arm.cog, arm.inertia


def _grown(values: Any) -> Any:
    return values[[0, 1, 2, 3, 4, 5, 5]]


def test_a_robots_library_is_loaded_only_when_its_driver_connects() -> None:
    code = (
        "import sys, drivers, gapbridge.bridge.cell.sections\n"
        "import gapbridge.drivers.ur_rtde.driver\n"
        "assert not {'rtde_receive', 'rtde_control', 'rtde_io'} & set(sys.modules)\n"
    )
    paths = [p for p in sys.path if p]
    found = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {paths!r}\n{code}"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
