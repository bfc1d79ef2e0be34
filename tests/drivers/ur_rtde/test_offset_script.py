"""gapbridge_offset.script itself, line by line: its text is run as Python, one cycle at a time."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapbridge.drivers.simulated.ur.programs.offset_program import OffsetRegisters, approach
from gapbridge.drivers.ur_rtde import command, registers

SCRIPT = Path(command.__file__).with_name("gapbridge_offset.script")
CYCLE = 0.002  # s
RATES = registers.rates(0.05, 0.1)
SILENCE = 101  # cycles without a heartbeat, after which the offset goes out
OFFSET = (1.0e-3, -5.0e-4, 2.0e-3, 1.0e-3, 0.0, -2.0e-3)


class CycleEnd(Exception):
    """What sync() does to a thread that is run pass by pass."""


def as_python(text: str) -> str:
    """Return the program up to the user's own part; its blocks end in ``end``, all else agrees."""
    body = text[text.index("def gapbridge_offset():\n") : text.index("# ---- YOUR PROGRAM")]
    lines = [line[2:] for line in body.splitlines()[1:] if line.strip() != "end"]
    names = ", ".join(sorted(set(re.findall(r"global (gb_\w+) =", body))))
    for pattern, by in (
        (r"\b(global|local) (?=\w+ =)", ""), (r"\brun \w+\(\)", "None"), (r"\bp\[", "["),
        (r"^(thread|def) (\w+\(.*\):)$", rf"def \2\n  global {names}"),
    ):  # fmt: skip
        lines = [re.sub(pattern, by, line) for line in lines]
    return "\n".join(lines)


class Robot:
    """A controller with the registers of the offset, and the program on it."""

    def __init__(self) -> None:
        self.integers, self.floats = [0] * 24, [0.0] * 24
        self.said, self.applied = [0] * 24, [0.0] * 24
        self.sequence = self.beat = 0
        self.offsets: list[list[float]] = []

        def end_cycle() -> None:
            raise CycleEnd

        def nothing(*_: Any) -> None:
            pass

        self.names: dict[str, Any] = {
            "floor": math.floor, "sqrt": math.sqrt, "get_steptime": lambda: CYCLE,
            "read_input_integer_register": self.integers.__getitem__,
            "read_input_float_register": self.floats.__getitem__,
            "write_output_integer_register": self.said.__setitem__,
            "write_output_float_register": self.applied.__setitem__,
            "path_offset_set": lambda pose, kind: self.offsets.append(pose),
            "path_offset_enable": nothing, "path_offset_set_max_offset": nothing, "sync": end_cycle,
        }  # fmt: skip
        exec(as_python(SCRIPT.read_text()), self.names)

    @property
    def shown(self) -> tuple[int, int]:
        """Sequence number accepted last, and the program's state."""
        return self.said[registers.ECHO], self.said[registers.PROGRAM]

    def send(self, offset: Sequence[float], rates: int = RATES, spoil: int = 0) -> None:
        """Write what the driver writes; the heartbeat is the sequence number."""
        self.sequence += 1
        counts = registers.counts(offset)
        self.floats[18:23] = [count * registers.UNIT for count in counts[:5]]
        total = registers.checksum(counts, self.sequence, rates)
        self.integers[18:23] = [counts[5], self.sequence, total + spoil, self.sequence, rates]

    def cycle(self, count: int = 1) -> list[float]:
        """Run the thread for so many cycles; returns the offset applied in the last."""
        for _ in range(count):
            with pytest.raises(CycleEnd):
                self.names["gapbridge_thread"]()
        assert self.applied[12:18] == self.offsets[-1]
        return self.offsets[-1]

    def hold(self, offset: Sequence[float], cycles: int) -> list[float]:
        """Send an offset in each of so many cycles."""
        for _ in range(cycles):
            self.send(offset)
            self.cycle()
        return self.offsets[-1]


def test_an_offset_is_accepted_echoed_and_reached_at_the_cells_rates() -> None:
    robot = Robot()
    assert robot.hold(OFFSET, 100) == pytest.approx(OFFSET, abs=1e-12)
    assert robot.shown == (robot.sequence, registers.Program.RUNNING)
    steps = np.abs(np.diff(robot.offsets, axis=0)).max(axis=0)
    assert steps[:3].max() <= 0.05 * CYCLE + 1e-12
    assert steps[3:].max() <= 0.1 * CYCLE + 1e-12


def test_what_is_left_in_the_registers_when_the_program_starts_moves_nothing() -> None:
    robot = Robot()
    robot.send(OFFSET)
    robot.names["gb_sequence"] = robot.names["gb_heartbeat"] = robot.sequence
    assert robot.cycle(50) == [0.0] * 6


@pytest.mark.parametrize("spoil", [1, -1, 2**20])
def test_a_wrong_checksum_leaves_the_offset_as_it_was(spoil: int) -> None:
    robot = Robot()
    before = robot.hold(OFFSET, 100)
    accepted = robot.sequence
    robot.send((0.0, 0.0, 9e-3, 0.0, 0.0, 0.0), spoil=spoil)
    assert robot.cycle() == before
    assert robot.shown == (accepted, registers.Program.REJECTED)


def test_without_a_heartbeat_the_offset_goes_out_at_the_cells_rates() -> None:
    robot = Robot()
    robot.hold(OFFSET, 100)
    begun = len(robot.offsets)
    assert robot.cycle(SILENCE + 60) == [0.0] * 6
    assert robot.shown[1] == registers.Program.EXPIRED
    lengths = np.linalg.norm(robot.offsets[begun:], axis=1)
    assert all(a >= b for a, b in pairwise(lengths))
    assert np.diff(lengths).min() >= -3e-4


@pytest.mark.parametrize("rates", [None, 0, 1 << 16, 1000, -1])
def test_registers_that_were_cleared_do_not_keep_an_offset_for_ever(rates: int | None) -> None:
    """All zero is a sum that fits, with rates at which nothing would ever go out again."""
    robot = Robot()
    before = robot.hold(OFFSET, 100)
    if rates is None:
        robot.floats[:], robot.integers[:] = [0.0] * 24, [0] * 24
    else:
        robot.send((0.0,) * 6, rates=rates)
    assert robot.cycle() == before
    assert robot.shown[1] == registers.Program.REJECTED
    assert robot.cycle(SILENCE + 60) == [0.0] * 6


def test_the_simulated_program_does_what_the_script_does() -> None:
    random = np.random.default_rng(5)
    robot = Robot()
    memory: dict[str, Any] = {}

    def copy_registers() -> None:
        memory.update({f"input_int_register_{i}": v for i, v in enumerate(robot.integers)})
        memory.update({f"input_double_register_{i}": v for i, v in enumerate(robot.floats)})

    copy_registers()
    simulated, applied = OffsetRegisters(memory), (0.0,) * 6
    for k in range(3000):
        kind = random.integers(5)
        if k % 700 < 400:
            offset = np.round(random.uniform(-3e-3, 3e-3, 6), 9)
            rates = RATES if kind else int(random.choice([0, -1, RATES // 3, 5 << 16]))
            robot.send(offset.tolist(), rates, spoil=int(kind == 1))
        robot.cycle()
        copy_registers()
        state = simulated.cycle(CYCLE)
        applied = approach(applied, simulated.wanted, simulated.steps)
        assert robot.shown == (memory.get("output_int_register_12", 0), state), k
        assert robot.offsets[-1] == pytest.approx(applied, abs=1e-12), k
