"""Every command of ur_rtde's control script by its code."""

from __future__ import annotations

from collections.abc import Callable

from gapbridge.drivers.simulated.ur.controller import Steps
from gapbridge.drivers.simulated.ur.programs.control_motions import MOTIONS, REALTIME_MOTIONS
from gapbridge.drivers.simulated.ur.programs.control_queries import QUERIES, REALTIME_QUERIES
from gapbridge.drivers.simulated.ur.programs.control_registers import Registers

#: Executed once; those that return steps block the script until they end.
COMMANDS: dict[int, Callable[[Registers], Steps | None]] = {**MOTIONS, **QUERIES}

#: Executed in every cycle in which the register holds them.
REALTIME: dict[int, Callable[[Registers], None]] = {**REALTIME_MOTIONS, **REALTIME_QUERIES}
