"""Sources of nominal setpoints, in an explicit table."""

from __future__ import annotations

from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, cast

from gapbridge.bridge.setpoint_source.source import SourceContext

if TYPE_CHECKING:
    from gapbridge.bridge.cell.sections import SetpointSettings
    from gapbridge.bridge.setpoint_source.source import Source
    from gapbridge.drivers.clock import Clock

SOURCES: dict[str, str] = {
    "target": "gapbridge.bridge.setpoint_source.target:TargetSource",
    "trajectory": "gapbridge.bridge.setpoint_source.trajectory:TrajectorySource",
    "modbus": "gapbridge.bridge.setpoint_source.modbus:ModbusSource",
    "planner": "gapbridge.bridge.setpoint_source.planner:PlannerSource",
    "tcp": "gapbridge.bridge.setpoint_source.tcp:TcpSource",
}
"""Name in a cell file (setpoints.source) -> ``module:Class``, imported when it is used."""


def make_source(
    settings: SetpointSettings, n: int, moves_arm: bool, folder: Path, clock: Clock,
    rate: float = 500.0,
) -> Source:  # fmt: skip
    """Return the source that the settings name, not yet open.

    ``n``: joints; ``moves_arm``: whether setpoints are the arm's only motion; ``folder``: where
    relative paths start; ``clock``: for sources whose setpoints come at their own times, the others
    follow the controller's; ``rate``: of the robot's cycles, Hz. Raises InputError if it cannot be
    used.
    """
    source_class = resolve_name(SOURCES[settings.source])
    context = SourceContext(settings, n, moves_arm, folder, rate, clock)
    return cast("Source", source_class(context))
