"""The robot says that it must not move."""

from __future__ import annotations

from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Row, cycles

LATCHED = ("fault",)


def _bench(line: str):  # type: ignore[no-untyped-def]
    def inject(rig: Rig) -> None:
        rig.controller.bench(line)

    return inject


ROWS = (
    Row("protective stop", "protective stop", "as a collision would", _bench("protective_stop"),
        within=cycles(6, 0.25), lasting=0.1, end=LATCHED),
    Row("emergency stop", "emergency stop", "the button", _bench("emergency_stop"),
        within=cycles(6, 0.25), lasting=0.1, end=LATCHED),
)  # fmt: skip
