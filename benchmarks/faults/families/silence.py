"""Nothing comes any more, or late: stalls, controllers that stand still, cables that are pulled."""

from __future__ import annotations

from benchmarks.faults.mischief import Times, changing, delaying, doubling, reordering
from benchmarks.faults.proxy import DOWN
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Row, cycles, seconds

SILENT = ("fault", "observing")  # a fault of the link is latched until the link is a new one
UR = ("ur_servoj", "ur_offset")


def _late(rig: Rig) -> None:
    """Delay what comes within a moment, so that one sample or two are missing."""
    rig.proxy.stall(2.5 * rig.link.cycle)


def _stall(duration: float):  # type: ignore[no-untyped-def]
    return lambda rig: rig.proxy.stall(duration)


def _freeze_clock(rig: Rig) -> None:
    rig.controller.bench("freeze")


def _freeze_in_packets(rig: Rig) -> None:
    """Have every packet say the same time from now on."""
    kept: list[list[float]] = []

    def same(clock: list[float]) -> list[float]:
        kept.append(clock)
        return kept[0]

    _patch(rig, "clock", same)


def _freeze_values(rig: Rig) -> None:
    """Have joints say the same for ever, and that they turn."""
    kept: dict[bytes, list[float]] = {}
    decoder, link = rig.decoder, rig.link

    def ruin(message: bytes) -> bytes:
        key = message[:11] if link.main == "can" else b""
        message = decoder.patch(message, "q", lambda q: kept.setdefault(key, q))
        return decoder.patch(message, "qd", lambda qd: [0.08] * len(qd))

    rig.found  # noqa: B018 - layouts are known from here on
    rig.proxy.do(DOWN, changing(ruin), link.main)


def _patch(rig: Rig, what: str, change) -> None:  # type: ignore[no-untyped-def]
    rig.found  # noqa: B018
    decoder = rig.decoder
    rig.proxy.do(
        DOWN, changing(lambda message: decoder.patch(message, what, change)), rig.link.main
    )


def _double(rig: Rig) -> None:
    rig.proxy.do(DOWN, Times(doubling, 200), rig.link.main)


def _reorder(rig: Rig) -> None:
    rig.proxy.do(DOWN, Times(reordering(), 60), rig.link.main)


def _jitter(rig: Rig) -> None:
    rig.proxy.do(DOWN, Times(delaying(1.5 * rig.link.cycle), 40), rig.link.main)


ROWS = (
    Row("late sample", "single late or missing sample", "proxy holds everything for 2.5 cycles",
        _late, sign="late", within=cycles(15, 0.25), end=("compensating",)),
    Row("stale link", "stale link, socket alive", "proxy hands nothing on for 0.12 or 0.3 s",
        lambda rig: rig.proxy.stall(rig.link.hold + (0.02 if rig.link.hold < 0.2 else 0.1)),
        end=SILENT),
    Row("silent link", "stale link, socket alive", "proxy hands nothing on for 0.4 s",
        _stall(0.4), end=SILENT),
    Row("half-open link", "half-open (cable pulled)", "proxy hands nothing on for 4 s",
        _stall(4.0), lasting=4.0, slow=True),
    Row("peer stands still", "controller stands still", "SIGSTOP of the controller for 0.4 s",
        lambda rig: rig.controller.stand_still(), lasting=0.35, end=SILENT),
    Row("frozen clock", "stale link, socket alive", "the controller's clock stops, packets go on",
        _freeze_clock, links=UR, lasting=0.3, end=SILENT),
    Row("frozen timestamp", "stale link, socket alive", "proxy writes the same timestamp",
        _freeze_in_packets, links=UR, lasting=0.3, end=SILENT),
    Row("frozen values", "frozen values, timestamp moving",
        "proxy writes the same joints, and velocities that say they turn",
        _freeze_values, within=seconds(1.5), end=SILENT),
    Row("doubled packets", "duplicate packets", "proxy sends 200 messages twice",
        _double, links=("ur_servoj", "ur_offset"), sign="none", end=("compensating",)),
)  # fmt: skip
