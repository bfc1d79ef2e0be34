"""The dashboard on port 29999: one line in, one line out.

Source of the sentences: Universal Robots, dashboard server guide (e-Series).
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from gapbridge.drivers.simulated.server.connection import Connection
from gapbridge.drivers.simulated.ur import modes
from gapbridge.drivers.simulated.ur.controller import Controller, Steps

log = logging.getLogger("drivers.simulated")

GREETING = b"Connected: Universal Robots Dashboard Server\n"
UNLOCK_AFTER = 5.0  # s after a protective stop


class DashboardServer:
    """Answers dashboard commands on one controller."""

    def __init__(self, controller: Controller, version: str, serial: str) -> None:
        self._controller = controller
        self._role = "NONE"
        self._plain: dict[str, Callable[[], str]] = {
            "play": self._play,
            "stop": self._stop,
            "pause": self._pause,
            "running": lambda: f"Program running: {str(self._playing).lower()}",
            "programstate": self._program_state,
            "get loaded program": self._loaded,
            "isprogramsaved": lambda: f"true {controller.loaded_program or '<unnamed>'}",
            "polyscopeversion": lambda: f"URSoftware {version} (Jan 01 2024)",
            "version": lambda: version,
            "get serial number": lambda: serial,
            "get robot model": lambda: controller.plant.arm.name.upper().rstrip("E"),
            "is in remote control": lambda: "true",
            "get operational mode": lambda: self._role,
            "clear operational mode": lambda: "No longer controlling the operational mode",
            "robotmode": self._robot_mode,
            "safetymode": lambda: f"Safetymode: {self._safety_name()}",
            "safetystatus": lambda: f"Safetystatus: {self._safety_name()}",
            "power on": self._power_on,
            "power off": self._power_off,
            "brake release": self._brake_release,
            "unlock protective stop": self._unlock,
            "close safety popup": lambda: "closing safety popup",
            "close popup": lambda: "closing popup",
            "restart safety": self._restart_safety,
            "savelog": lambda: "Log saved to disk",
            "help": lambda: "Commands: " + ", ".join(sorted(self._plain)),
        }

    def greet(self, connection: Connection) -> None:
        """Send the line that every client waits for."""
        connection.send(GREETING)

    def handle(self, connection: Connection) -> None:
        """Answer every complete line."""
        for line in connection.lines():
            if line.lower() in ("quit", "shutdown"):
                parting = b"Disconnected\n" if line.lower() == "quit" else b"Shutting down\n"
                connection.send(parting)
                connection.close()
                return
            connection.send(self.answer(line).encode() + b"\n")

    def answer(self, line: str) -> str:
        """Return the reply to one command."""
        action = self._plain.get(line.lower())
        if action is not None:
            return action()
        word, _, tail = line.partition(" ")
        argument = tail.strip()
        if word.lower() == "load":
            return self._load(argument)
        if word.lower() == "popup":
            return "showing popup"
        if word.lower() == "addtolog":
            log.info("dashboard log: %s", argument)
            return "Added log message"
        if word.lower() == "setuserrole":
            return f"Setting user role: {argument}"
        if line.lower().startswith("set operational mode"):
            self._role = line.split()[-1].upper()
            return f"Operational mode '{self._role.lower()}' is set"
        log.warning("dashboard: unknown command %r", line)
        return f'could not understand: "{line}"'

    # -- programs -------------------------------------------------------------------------------

    @property
    def _playing(self) -> bool:
        return bool(self._controller.memory["runtime_state"] == modes.PLAYING)

    def _load(self, name: str) -> str:
        if not name.endswith((".urp", ".script")):
            return f"File not found: {name}"
        self._controller.load_program(name)
        return f"Loading program: {name}"

    def _loaded(self) -> str:
        name = self._controller.loaded_program
        return f"Loaded program: {name}" if name else "No program loaded"

    def _play(self) -> str:
        controller = self._controller
        if not controller.can_move:
            return "Failed to execute: play"
        if controller.program is not None:
            if controller.memory["runtime_state"] == modes.PAUSED:
                controller.resume()
            return "Starting program"
        if not controller.loaded_program:
            return "Failed to execute: play"
        controller.start_program(controller.loaded_program, _idle())
        return "Starting program"

    def _stop(self) -> str:
        self._controller.end_program()
        return "Stopped"

    def _pause(self) -> str:
        if not self._playing:
            return "Failed to execute: pause"
        self._controller.pause()
        return "Pausing program"

    def _program_state(self) -> str:
        state = self._controller.memory["runtime_state"]
        word = {modes.PLAYING: "PLAYING", modes.PAUSED: "PAUSED"}.get(state, "STOPPED")
        return f"{word} {self._controller.loaded_program or '<unnamed>'}"

    # -- power and safety -----------------------------------------------------------------------

    def _robot_mode(self) -> str:
        return f"Robotmode: {modes.ROBOT_MODE_NAMES[self._controller.memory['robot_mode']]}"

    def _safety_name(self) -> str:
        return modes.SAFETY_MODE_NAMES[self._controller.memory["safety_mode"]]

    def _power_on(self) -> str:
        controller = self._controller
        if controller.memory["safety_mode"] != modes.SAFETY_NORMAL:
            return "Failed to execute: power on"
        if controller.memory["robot_mode"] < modes.IDLE:
            controller.set_robot_mode(modes.IDLE)
        return "Powering on"

    def _power_off(self) -> str:
        self._controller.end_program()
        self._controller.set_robot_mode(modes.POWER_OFF)
        return "Powering off"

    def _brake_release(self) -> str:
        controller = self._controller
        if controller.memory["safety_mode"] != modes.SAFETY_NORMAL:
            return "Failed to execute: brake release"
        controller.set_robot_mode(modes.RUNNING)
        return "Brake releasing"

    def _unlock(self) -> str:
        controller = self._controller
        if controller.memory["safety_mode"] == modes.SAFETY_PROTECTIVE:
            if controller.clock - controller.stopped_at < UNLOCK_AFTER:
                return (
                    "Cannot unlock protective stop until 5s after occurrence. "
                    "Always inspect cause of protective stop before unlocking"
                )
            controller.set_safety(modes.SAFETY_NORMAL)
        return "Protective stop releasing"

    def _restart_safety(self) -> str:
        self._controller.set_safety(modes.SAFETY_NORMAL)
        self._power_off()
        return "Restarting safety"


def _idle() -> Steps:
    """Run a loaded program: it holds the arm until it is stopped."""
    while True:
        yield
