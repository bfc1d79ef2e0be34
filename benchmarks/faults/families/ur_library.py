"""What ur_rtde does when a controller misbehaves: it aborts, crashes, hangs, or says nothing.

Each was measured with a server that does so (docs/reliability.md); the loop's process may die of
it, the daemon must not, and no unbounded setpoint may leave meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.faults.mischief import Outcome, Times
from benchmarks.faults.proxy import DOWN
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Inject, Row, seconds

UR = ("ur_servoj", "ur_offset")
GOES_ON = ("compensating",)


def _packets(mischief: Callable[[bytes], Outcome], count: int = 1) -> Inject:
    """Return an injection: something happens to the next data packages of each connection."""

    def inject(rig: Rig) -> None:
        times = Times(mischief, count, lambda message: message[2:3] == b"U")
        rig.proxy.do(DOWN, times, "rtde")

    return inject


def _sized(size: int) -> Callable[[bytes], Outcome]:
    return lambda message: [(0.0, size.to_bytes(2, "big") + message[2:])]


def _short(message: bytes) -> Outcome:
    cut = message[:-16]
    return [(0.0, len(cut).to_bytes(2, "big") + cut[2:])]


def _empty(message: bytes) -> Outcome:
    return [(0.0, b"\x00\x03U")]


def _split(message: bytes) -> Outcome:
    return [(0.0005, message[:40]), (0.001, message[40:])]


def _double(message: bytes) -> Outcome:
    return [(0.0, message), (0.0, message)]


def _recipe(message: bytes) -> Outcome:
    return [(0.0, message[:3] + b"\x77" + message[4:])]


def _with(extra: bytes) -> Callable[[bytes], Outcome]:
    return lambda message: [(0.0, extra), (0.0, message)]


def _cut_in_packet(rig: Rig) -> None:
    _packets(lambda message: [(0.0, message[:30])], 2)(rig)
    rig.proxy.inject(DOWN, "rtde", b"")
    rig.proxy.cut(reset=False)


TEXT = b"\x00\x13M" + b"\x05hello\x05there\x03" + b"\x00\x00\x00"
SOON = seconds(0.5)
ENDS = ("observing", "compensating", "fault")

ROWS = (
    Row("short packets", "packet shorter than its recipe", "20 packets without their last 16 bytes",
        _packets(_short, 20), UR, "none", SOON, ENDS),
    Row("size field 0", "size field 0 or 2 (library aborts)", "size field of one packet is 0",
        _packets(_sized(0), 2), UR, within=SOON, slow=True),
    Row("size field 2", "size field 0 or 2 (library aborts)", "size field of one packet is 2",
        _packets(_sized(2), 2), UR, within=SOON, slow=True),
    Row("empty packet", "data packet of size 3 (library crashes)", "a data packet without payload",
        _packets(_empty, 2), UR, within=SOON, slow=True),
    Row("size field 65535", "size field 65535 (library goes silent)", "size field of one packet",
        _packets(_sized(0xFFFF), 2), UR, within=SOON, slow=True),
    Row("cut within a packet", "stream cut mid-packet", "half a packet, then FIN",
        _cut_in_packet, UR, within=SOON, slow=True),
    Row("split packets", "packet in two pieces", "100 packets in two pieces 0.5 ms apart",
        _packets(_split, 100), UR, "none", SOON, GOES_ON),
    Row("wrong recipe", "wrong recipe id", "50 packets with another recipe's number",
        _packets(_recipe, 50), UR, "none", SOON, GOES_ON),
    Row("unknown type", "unknown message type", "a message of type Z before 50 packets",
        _packets(_with(b"\x00\x05Zxy"), 50), UR, "none", SOON, GOES_ON),
    Row("text messages", "text message", "a text message before 50 packets",
        _packets(_with(TEXT), 50), UR, "none", SOON, GOES_ON),
)  # fmt: skip
