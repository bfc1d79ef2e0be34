"""Checks before a run of what the loop's process reads at its start."""

from __future__ import annotations

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.message import located_message, message_at
from gapbridge.bridge.setpoint_source import make_source
from gapbridge.core.errors import CellError, InputError
from gapbridge.drivers import make_driver
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.link_settings import ProfileSettings
from gapbridge.drivers.replay.settings import ReplaySettings


def require_runnable(cell: Cell, settings: DaemonSettings, clock: Clock) -> None:
    """Raise CellError for a profile, a recording or a trajectory that the loop would refuse."""
    link, replays = settings.link, isinstance(settings.link, ReplaySettings)
    try:
        if replays or isinstance(link, ProfileSettings):
            make_driver(link, cell.model, clock=clock)  # compares it with the arm
    except InputError as error:
        if not replays:  # a profile's error names its own place
            raise CellError(located_message(cell.document, error)) from None
        keys = error.keys or ("link", "file")
        raise CellError(message_at(cell.document, keys, error.message)) from None
    if replays:
        return  # its setpoints are recorded
    try:
        make_source(
            settings.setpoints, cell.arm.n, link.moves_arm, cell.path.parent, clock, link.rate
        )
    except InputError as error:
        keys = error.keys or ("setpoints", "file")
        raise CellError(message_at(cell.document, keys, error.message)) from None
