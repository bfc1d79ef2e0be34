"""States that cannot be true: no numbers, leaps, samples that are torn."""

from __future__ import annotations

import itertools
import math

from benchmarks.faults.mischief import Times, changing, losing
from benchmarks.faults.proxy import DOWN
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Inject, Row, cycles
from benchmarks.faults.wire.seen import Change

UR = ("ur_servoj", "ur_offset")
LEAP = 0.3  # rad
DROPPED = "dropped_torn|dropped_not_finite|dropped_implausible|dropped_step"
FRAMES = {"can": 3}  # messages of one state, where it is not one


def ruin_states(change: Change, count: int) -> Inject:
    """Return an injection: the joints of the next ``count`` states are changed."""

    def inject(rig: Rig) -> None:
        rig.found  # noqa: B018 - layouts are known from here on
        decoder, main = rig.decoder, rig.link.main

        def has_joints(message: bytes) -> bool:
            return decoder.patch(message, "q", lambda q: [v + 1.0 for v in q]) != message

        mischief = changing(lambda message: decoder.patch(message, "q", change))
        times = Times(mischief, count * FRAMES.get(main, 1), has_joints)
        rig.proxy.do(DOWN, times, main)

    return inject


def _leap(q: list[float]) -> list[float]:
    return [v + LEAP for v in q]


def _not_finite(q: list[float]) -> list[float]:
    return [math.nan, *q[1:]]


def _infinite(q: list[float]) -> list[float]:
    return [q[0], -math.inf, *q[2:]]


_signs = itertools.cycle((LEAP, LEAP, LEAP, -LEAP, -LEAP, -LEAP))  # as many as a state's frames


def _to_and_fro(q: list[float]) -> list[float]:
    leap = next(_signs)
    return [v + leap for v in q]


def _tear(rig: Rig) -> None:
    """Lose one frame of three, once."""
    times = Times(losing, 1, lambda message: message.startswith(b"< frame 2A6"))
    rig.proxy.do(DOWN, times, "can")


def _tear_registers(rig: Rig) -> None:
    rig.controller.bench("tear 4")  # images of the controller; a reading comes every third or so


AT_ONCE = cycles(8, 0.25)
GOES_ON = ("compensating",)

ROWS = (
    Row("one NaN", "NaN", "proxy writes one NaN into the joints", ruin_states(_not_finite, 1),
        UR, DROPPED, AT_ONCE, GOES_ON),
    Row("NaN for long", "NaN, 3 in a row", "NaN in 20 states in a row",
        ruin_states(_not_finite, 20), UR, within=AT_ONCE),
    Row("infinite for long", "Inf, 3 in a row", "-inf in 20 states in a row",
        ruin_states(_infinite, 20), UR, within=AT_ONCE),
    Row("one leap", "step > v_max dt", "proxy moves all joints by 0.3 rad in one state",
        ruin_states(_leap, 1), sign=DROPPED, within=AT_ONCE, end=GOES_ON),
    Row("leaps for long", "step > v_max dt, 3 in a row", "to and fro by 0.3 rad in 20 states",
        ruin_states(_to_and_fro, 20), within=cycles(12, 0.3),
        # an arm that we move is then farther from its command than limits.following
        end=("observing", "fault")),
    Row("torn sample", "torn sample", "one of three frames lost", _tear, ("can",), DROPPED,
        AT_ONCE, GOES_ON),
    Row("torn registers", "torn sample", "registers of two moments in one answer",
        _tear_registers, ("modbus",), DROPPED, AT_ONCE, GOES_ON),
)  # fmt: skip
