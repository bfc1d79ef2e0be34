"""Port 30003: programs arrive as text, and the matching emulation is run.

The control script that ur_rtde uploads is emulated, a handshake over registers. The client writes a
command code to input_int_register_0 with arguments behind it, waits for output_int_register_0 to
become 2 (done), clears the command and waits for 1 (ready). Real-time commands are executed in
every cycle in which the register holds them and never leave 1. All registers are shifted by the
offset that the client wrote into the script (0 or 24).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass

from gapbridge.drivers.simulated.server.connection import Connection
from gapbridge.drivers.simulated.ur.controller import Controller, ScriptError, Steps
from gapbridge.drivers.simulated.ur.programs import offset_program
from gapbridge.drivers.simulated.ur.programs.control_motions import MOTIONS, REALTIME_MOTIONS
from gapbridge.drivers.simulated.ur.programs.control_queries import QUERIES, REALTIME_QUERIES
from gapbridge.drivers.simulated.ur.programs.control_registers import Registers
from gapbridge.drivers.simulated.ur.programs.script_programs import script_program
from gapbridge.drivers.simulated.ur.programs.script_text import ScriptText, take_script

log = logging.getLogger("drivers.simulated")
READY, DONE = 1, 2
STOP_SCRIPT = 255
_OFFSET = re.compile(r"#\s*(int|float) register offset\s*\n\s*(\d+)")
_PATH_MARK = "# inject move path"
#: Executed once; those that return steps block the script until they end.
COMMANDS: dict[int, Callable[[Registers], Steps | None]] = {**MOTIONS, **QUERIES}

#: Executed in every cycle in which the register holds them.
REALTIME: dict[int, Callable[[Registers], None]] = {**REALTIME_MOTIONS, **REALTIME_QUERIES}


class ScriptServer:
    """Starts uploaded programs. Unlike a real controller it sends no data stream on this port."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller

    def handle(self, connection: Connection) -> None:
        """Start every complete program that has arrived; the last one keeps running."""
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
        secondary = script.kind == "sec"  # runs beside and does not move the arm
        steps = script_program(controller, script.name, script.lines, secondary)
        if not secondary:
            controller.start_program(script.name, steps)
            return
        try:
            for _ in zip(range(1000), steps, strict=False):
                pass
        except ScriptError as error:
            log.warning("program %s stops: %s", script.name, error)


@dataclass(frozen=True, slots=True)
class ControlText:
    """What the client wrote into the control script."""

    int_offset: int
    float_offset: int
    path: tuple[str, ...]


def read_control_text(script: ScriptText) -> ControlText | None:
    """Return register offsets and path of an uploaded control script; None: another program."""
    body = "\n".join(script.lines)
    offsets = {kind: int(number) for kind, number in _OFFSET.findall(body)}
    if script.name != "rtde_control" and len(offsets) < 2:
        return None
    path: list[str] = []
    marked = [i for i, line in enumerate(script.lines) if line.strip() == _PATH_MARK]
    if marked:
        for line in script.lines[marked[0] + 1 :]:
            if line.strip() == "end":
                break
            path.append(line.strip())
    return ControlText(offsets.get("int", 0), offsets.get("float", 0), tuple(path))


def control_script(controller: Controller, text: ControlText) -> Steps:
    """Run the control script: one pass of its main loop per cycle, until it is asked to stop."""
    registers = Registers(controller, text.int_offset, text.float_offset, text.path)
    try:
        registers.finish_operation()
        registers.state(READY)
        yield from _main_loop(registers)
    finally:
        registers.clear()


def _main_loop(registers: Registers) -> Steps:
    executed = False
    while True:
        registers.follow_operation()
        command = registers.command()
        if command == STOP_SCRIPT:
            return
        if command == 0:
            executed = False
            registers.state(READY)
        elif command in REALTIME:
            REALTIME[command](registers)
            registers.state(READY)
        elif not executed:
            executed = True
            yield from _execute(registers, command)
            registers.state(DONE)
        yield


def _execute(registers: Registers, command: int) -> Steps:
    """Run a command to its end; an unknown one ends at once."""
    action = COMMANDS.get(command)
    if action is None:
        log.warning("control script: command %d is unknown and ignored", command)
        return
    steps = action(registers)
    if steps is not None:
        yield from steps
