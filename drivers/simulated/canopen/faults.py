"""Bench commands of simulated drives: faults that a person makes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.simulated.server.bench import BenchError, Command


class Faulty(Protocol):
    """The drives as these commands need them."""

    profile: CanopenProfile

    def silence(self, node: int) -> None:
        """Have a node send nothing."""
        ...

    def speak(self) -> None:
        """Have all nodes send again."""
        ...

    def restart(self, node: int) -> None:
        """Have a node start anew."""
        ...

    def fail(self, node: int, code: int) -> None:
        """Have a drive fail."""
        ...

    def hold_back(self, node: int, delay: float, count: int = 1) -> None:
        """Have TPDOs of a node come late."""
        ...


def bench_commands(drives: Faulty) -> Mapping[str, Command]:
    """Return the commands by name."""
    nodes = drives.profile.nodes

    def node_of(number: float) -> int:
        if number not in nodes:
            raise BenchError(f"found node {number:g}, expected one of {nodes}")
        return int(number)

    def silence(numbers: list[float]) -> str:
        drives.silence(node_of(numbers[0]))
        return "ok"

    def speak(numbers: list[float]) -> str:
        drives.speak()
        return "ok"

    def restart(numbers: list[float]) -> str:
        drives.restart(node_of(numbers[0]))
        return "ok"

    def fail(numbers: list[float]) -> str:
        drives.fail(node_of(numbers[0]), int(numbers[1]) & 0xFFFF)
        return "ok"

    def late(numbers: list[float]) -> str:
        drives.hold_back(node_of(numbers[0]), max(numbers[1], 0.0))
        return "ok"

    return {
        "silence": (1, silence, "NODE: this drive sends nothing any more"),
        "speak": (0, speak, "all drives send again"),
        "restart": (1, restart, "NODE: this drive starts anew"),
        "fail": (2, fail, "NODE CODE: this drive goes to FAULT with an error code"),
        "late": (2, late, "NODE SECONDS: its next TPDOs come so late"),
    }
