"""Every case of the contract: one file a family, one line here."""

from __future__ import annotations

from collections.abc import Callable

from contract_can import can_cases
from contract_canopen import canopen_cases
from contract_case import Case
from contract_ft_sensor import ft_sensor_cases
from contract_modbus import modbus_cases

CASES: dict[str, Callable[[], Case]] = {
    **can_cases(),
    **canopen_cases(),
    **modbus_cases(),
    **ft_sensor_cases(),
}
"""Name -> what makes the case, its controller not yet serving."""
