"""The registers of ur_rtde's control script, shifted by the script's offsets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gapbridge.drivers.simulated.plant.kinematics import Joints
from gapbridge.drivers.simulated.plant.motion import Motion
from gapbridge.drivers.simulated.plant.plant_settings import Vector6
from gapbridge.drivers.simulated.ur.controller import Controller

RESULTS = 6
RUNNING_BIT = 1 << 15
MOST_PROGRESS = 0x7FFF


class Registers:
    """Arguments in, results out, and the register that reports asynchronous operations."""

    def __init__(
        self,
        controller: Controller,
        int_offset: int,
        float_offset: int,
        path: tuple[str, ...] = (),
    ) -> None:
        self.controller = controller
        self.path = path
        self._in_int = [f"input_int_register_{int_offset + i}" for i in range(8)]
        self._in_double = [f"input_double_register_{float_offset + i}" for i in range(18)]
        self._out_int = [f"output_int_register_{int_offset + i}" for i in range(3)]
        self._out_double = [f"output_double_register_{float_offset + i}" for i in range(RESULTS)]
        self.watched = self._in_int[0]
        self._memory = controller.memory
        self._changes = 0
        self._operation = 0
        self._running: Motion | None = None

    def command(self) -> int:
        """Return the command code that the client holds in its register."""
        return int(self._memory[self._in_int[0]])

    def integer(self, index: int) -> int:
        """Return an integer argument."""
        return int(self._memory[self._in_int[index]])

    def number(self, index: int) -> float:
        """Return a real argument. Raises ScriptError if it is not finite."""
        return self.controller.finite((self._memory[self._in_double[index]],), "argument")[0]

    def joints(self, first: int = 0) -> Joints:
        """Return six real arguments. Raises ScriptError if one is not finite."""
        memory = self._memory
        values = [memory[name] for name in self._in_double[first : first + 6]]
        return self.controller.finite(values, "argument")

    def pose(self, first: int = 0) -> Vector6:
        """Return a pose argument: m and rotation vector."""
        a, b, c, d, e, f = self.joints(first)
        return (a, b, c, d, e, f)

    def state(self, value: int) -> None:
        """Notify the client: 1 ready, 2 done with the command."""
        self._memory[self._out_int[0]] = value

    def answer(self, value: int) -> None:
        """Give an integer result."""
        self._memory[self._out_int[1]] = value

    def answer_vector(self, values: Sequence[float]) -> None:
        """Give a real result of up to six numbers."""
        self._memory.update(zip(self._out_double, map(float, values), strict=False))

    def clear(self) -> None:
        """Clear the registers for the next program."""
        memory: dict[str, Any] = self._memory
        for name in self._out_int:
            memory[name] = 0

    # -- asynchronous operations ------------------------------------------------------------------

    def start_operation(self, motion: Motion) -> None:
        """Start a motion concurrently with the script, and report it."""
        self.controller.start_motion(motion)
        self._running = motion
        self.progress(0)

    def follow_operation(self) -> None:
        """Report the end of an asynchronous motion when it has ended or was replaced."""
        running = self._running
        if running is not None and (running.done or self.controller.motion is not running):
            self.finish_operation()

    def finish_operation(self) -> None:
        """Report that no operation runs."""
        self._running = None
        self.progress(-1)

    def progress(self, value: int) -> None:
        """Write the progress word: bits 0-14 progress, 15 running, 16-22 changes, 24-30 number."""
        self._changes = (self._changes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = self._changes << 16 | self._operation << 24
        if value >= 0:
            word |= min(value, MOST_PROGRESS) | RUNNING_BIT
        self._memory[self._out_int[2]] = word
