"""The RTDE registers of the offset mode: inputs, and the answers of the robot's program.

=========================  ====================================================================
input_double_register_18   offset x, m; 19 y, 20 z, 21 rotation vector x (rad), 22 y; base axes
input_int_register_18      rotation vector z in 1e-9 rad
input_int_register_19      sequence number, written last: it makes the offset valid
input_int_register_20      checksum
input_int_register_21      heartbeat: any change
input_int_register_22      the cell's rates, in every checksum: 65536 times m/s in RATE_UNIT, plus
                           rad/s in TURN_RATE_UNIT; the program's steps are no larger
output_int_register_12     sequence number of the last offset that the program accepted
output_int_register_13     0 no program, 1 running, 2 watchdog expired, 3 wrong checksum
output_double_register_12  offset applied in this cycle: 12 to 17, x, y, z, rotation vector
=========================  ====================================================================

The library reaches no other registers: 18 to 22 on the way in, 12 to 19 on the way out, five of
each kind in and eight out, which is why one of the six numbers travels as an integer.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

OFFSET_DOUBLES = (18, 19, 20, 21, 22)
OFFSET_RZ, SEQUENCE, CHECKSUM, HEARTBEAT, RATES = 18, 19, 20, 21, 22
ECHO, PROGRAM = 12, 13
APPLIED = (12, 13, 14, 15, 16, 17)

UNIT = 1e-9  # m and rad: resolution of the offset
RATE_UNIT, TURN_RATE_UNIT = 4e-5, 1e-4  # m/s, rad/s: resolution of the rates
LARGEST_RATE, LARGEST_TURN_RATE = 0x7FFF, 0xFFFF  # counts
LAST_SEQUENCE = 1_000_000  # 31 times it fits a 32 bit integer
MODULUS = 2**31


class Program(IntEnum):
    """State that the robot's program reports."""

    ABSENT = 0
    RUNNING = 1
    EXPIRED = 2
    REJECTED = 3


def counts(offset_in_base: Sequence[float]) -> list[int]:
    """Return an offset (6,) in m and rad as whole numbers of UNIT."""
    return [round(v / UNIT) for v in offset_in_base]


def rates(offset_rate: float, turn_rate: float) -> int:
    """Return m/s and rad/s as one register, rounded down: the program is never faster.

    Raises ValueError for what rounds down to nothing.
    """
    shift = min(int(offset_rate / RATE_UNIT * (1.0 + 1e-9)), LARGEST_RATE)
    turn = min(int(turn_rate / TURN_RATE_UNIT * (1.0 + 1e-9)), LARGEST_TURN_RATE)
    if shift < 1:
        raise ValueError(f"offset_rate: found {offset_rate:g} m/s, expected {RATE_UNIT:g} at least")
    if turn < 1:
        raise ValueError(
            f"offset_rotation_rate: found {turn_rate:g} rad/s, expected {TURN_RATE_UNIT:g} at least"
        )
    return shift << 16 | turn


def checksum(units: Sequence[int], sequence: int, rates: int) -> int:
    """Return the checksum of an offset in UNIT: their sum, rates and 31 sequence, modulo 2^31."""
    return (sum(units) + rates + 31 * sequence) % MODULUS


def next_sequence(sequence: int) -> int:
    """Return the number after ``sequence``: 1 to LAST_SEQUENCE, round and round."""
    return sequence % LAST_SEQUENCE + 1


def reached(echo: int, sequence: int) -> bool:
    """Return whether an echoed number is ``sequence`` or one after it; 0 is none at all."""
    return echo != 0 and (echo - sequence) % LAST_SEQUENCE < LAST_SEQUENCE // 2
