"""Messages that are no answers: ruined, foreign, cut off; what each protocol's client does then."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.faults.mischief import Times, changing
from benchmarks.faults.proxy import DOWN
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Inject, Row, cycles, seconds

UR, MODBUS, CAN = ("ur_servoj", "ur_offset"), ("modbus",), ("can",)
GOES_ON = ("compensating",)
Ruin = Callable[[bytes], bytes]


def _ruin(ruin: Ruin, count: int) -> Inject:
    """Return an injection: the next ``count`` messages are ruined."""

    def inject(rig: Rig) -> None:
        rig.proxy.do(DOWN, Times(changing(ruin), count, _is_answer), rig.link.main)

    return inject


def _is_answer(message: bytes) -> bool:
    """Return whether a message is an answer to a reading (Modbus) or anything at all (others)."""
    return len(message) > 20


def _other_function(answer: bytes) -> bytes:
    return answer[:7] + b"\x04" + answer[8:]


def _fewer_registers(answer: bytes) -> bytes:
    return answer[:4] + b"\x00\x07" + answer[6:8] + b"\x04" + answer[9:13]


def _refusal(answer: bytes) -> bytes:
    return answer[:4] + b"\x00\x03" + answer[6:7] + bytes([answer[7] | 0x80, 6])


def _transaction_zero(answer: bytes) -> bytes:
    return b"\x00\x00" + answer[2:]


def _half(answer: bytes) -> bytes:
    return answer[: len(answer) // 2]


def _noise(answer: bytes) -> bytes:
    return bytes(range(7, 200))


def _no_socketcand(message: bytes) -> bytes:
    return b"< frame 2A5 zz zz >"


def _flood(rig: Rig) -> None:
    """Fill the bus: 10,000 frames at the rate that 1 Mbit/s carries, 8 a millisecond."""
    frame = b"< frame 7DF 0.0 0102030405060708 >"
    for _ in range(125):
        rig.proxy.inject(DOWN, "can", frame * 80)
        rig.pass_time(0.01)


def _error_frames(rig: Rig) -> None:
    rig.proxy.inject(DOWN, "can", b"< error 0004 0.0 >" * 20)


DROPS = "dropped_torn|dropped_step|dropped_implausible|late|stale"
SOON, LATER = cycles(12, 0.3), cycles(25, 0.5)
_MODBUS: tuple[tuple[str, Ruin], ...] = (
    ("wrong function", _other_function), ("short answer", _fewer_registers),
    ("exception code", _refusal), ("transaction zero", _transaction_zero),
    ("half an answer", _half), ("noise", _noise),
)  # fmt: skip

ROWS = (
    *(Row(f"{name}, once", f"{name}", "proxy ruins one answer", _ruin(ruin, 1), MODBUS, DROPS,
          SOON, GOES_ON) for name, ruin in _MODBUS),
    *(Row(f"{name}, for long", f"{name}, 3 in a row", "proxy ruins 15 answers", _ruin(ruin, 15),
          MODBUS, within=LATER, end=("observing", "fault")) for name, ruin in _MODBUS[:4]),
    Row("broken text, once", "short or corrupt message", "one message is no frame",
        _ruin(_no_socketcand, 1), CAN, "none", SOON, GOES_ON),
    Row("flood", "CAN flood, queue growth", "10,000 frames of a foreign identifier, 8 each ms",
        _flood, CAN, "none", SOON, ("compensating", "observing")),
    Row("error frames", "CAN error frames", "20 error frames", _error_frames, CAN, "none",
        seconds(1.0), ("compensating", "observing")),
)  # fmt: skip
