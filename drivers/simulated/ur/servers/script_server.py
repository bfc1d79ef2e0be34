"""Port 30003: programs arrive as text; what runs depends on what they are."""

from __future__ import annotations

import logging

from gapbridge.drivers.simulated.peer.connection import Connection
from gapbridge.drivers.simulated.ur.controller import Controller
from gapbridge.drivers.simulated.ur.programs import offset_program
from gapbridge.drivers.simulated.ur.programs.control_script import control_script, read_control_text
from gapbridge.drivers.simulated.ur.programs.script_programs import script_program
from gapbridge.drivers.simulated.ur.programs.script_text import ScriptText, take_script

log = logging.getLogger("drivers.simulated")


class ScriptServer:
    """Starts uploaded programs. Unlike a real controller it sends no data stream on this port."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller

    def handle(self, connection: Connection) -> None:
        """Start every whole program that has arrived; the last one stays."""
        while (script := take_script(connection.received)) is not None:
            self._start(script)

    def _start(self, script: ScriptText) -> None:
        controller = self._controller
        control = read_control_text(script)
        if control is not None:
            controller.start_program(script.name, control_script(controller, control))
            return
        if script.name == offset_program.NAME:
            steps = offset_program.offset_program(controller)
            controller.start_program(script.name, steps)
            return
        log.info("program %s uploaded (%d lines)", script.name, len(script.lines))
        steps = script_program(controller, script.name, script.lines)
        if script.kind == "sec":  # a secondary program runs beside and does not move the arm
            for _ in zip(range(1000), steps, strict=False):
                pass
            return
        controller.start_program(script.name, steps)
