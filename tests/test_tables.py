"""Every member that a table names by module and attribute can be imported from there."""

from __future__ import annotations

import importlib

import pytest

from bridge.calibration.instruments import INSTRUMENTS
from bridge.calibration.jobs.table import JOBS
from bridge.cell.simulation import SIMULATORS
from bridge.cli.table import COMMANDS
from bridge.daemon.sides import SIDES
from bridge.setpoint_source import SOURCES
from drivers import DRIVERS
from drivers.ft_sensor import FT_SENSORS

NAMED = [
    *INSTRUMENTS.values(),
    *JOBS.values(),
    *SIMULATORS.values(),
    *(name for name, _ in COMMANDS.values()),
    *(f"{module}:main" for module, _ in SIDES.values()),
    *SOURCES.values(),
    *DRIVERS.values(),
    *FT_SENSORS.values(),
]


@pytest.mark.parametrize("name", NAMED)
def test_a_named_member_is_where_its_table_says(name: str) -> None:
    module, member = name.split(":")
    assert callable(getattr(importlib.import_module(module), member))
