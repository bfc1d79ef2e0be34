"""Making one fault on a running rig, and seeing what becomes of it."""

from __future__ import annotations

import time

from benchmarks.faults.punctual import LATE
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Result, Row
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.checks import OVERRUN_SPAN
from gapbridge.bridge.loop.supervisor import Cause

POLL = 0.001  # s
AFTERWARDS = 0.25  # s for which the end state must stay
RESTING, AT_REST = (State.OBSERVING, State.COMPENSATING, State.FAULT), 3.0  # s: stays for good
END_LIMIT = 90.0  # s: a new process takes its time on a busy machine
PATIENCE = 10.0  # s on top of what is allowed, to distinguish what is late from what never comes
BUSY = (Cause.OVERRUN.value, Cause.RESYNC.value)


def make_fault(rig: Rig, row: Row) -> Result:
    """Make a row's fault while the daemon compensates; returns what became of it."""
    rig.compensate()
    assert row.inject is not None
    found = rig.found
    found.largest_step, before = 0.0, found.violated
    counts, first = rig.run.memory.counts(), rig.run.memory.written
    moment = time.time()
    row.inject(rig)
    detected = _await(rig, row, moment, counts)
    # whoever takes the newest state only has not seen one that was overtaken: nor its fault
    missed = _missed(rig, first) if detected is None else 0
    rig.pass_time(row.lasting)
    rig.heal()
    if row.after is not None:
        row.after(rig)
    end = _settle(rig, row)
    found = rig.found
    wrong = (
        _judge(rig, row, detected, end, missed)
        + found.violations[-(found.violated - before) or 9999 :]
    )
    bounds = rig.checker.bounds
    return Result(
        row.key, rig.link.name, rig.link.cycle, detected, end, found.largest_step,
        bounds.offset_rate * bounds.cycle, tuple(wrong), found.violated > before,
        _late(rig, row, moment, detected),
    )  # fmt: skip


def _late(rig: Rig, row: Row, moment: float, detected: float | None) -> float:
    """Return how late the machine was meanwhile, s; 0 where the fault bears that.

    Also shortly before: the loop counts what it missed within a span. Where it reports that it
    missed deadlines, half a cycle is enough for that; a loop that misses them on a machine that was
    on time is to blame itself. Half a cycle is also enough for a proxy to make the fault too late.
    """
    of_the_loop = "overrun" not in row.sign and any(
        event.get("cause") in BUSY for event in rig.run.since(moment)
    )
    # where the loop has to ask, a cycle waits for it, the proxy, the controller, the proxy again
    half = min(LATE, 0.5 * rig.link.cycle / (1 if rig.link.behind else 4))
    made = time.monotonic() - (time.time() - moment)
    late = rig.witness.late(made - OVERRUN_SPAN, half if of_the_loop else LATE)
    if not late and detected is None:
        late = rig.witness.late(made - OVERRUN_SPAN, half, until=made + row.within(rig.link))
    return late


def _await(rig: Rig, row: Row, moment: float, before: dict[str, int]) -> float | None:
    """Return how long after ``moment`` the fault was detected, s."""
    until = time.monotonic() + row.within(rig.link) + PATIENCE
    while time.monotonic() < until:
        if row.sign == "none":
            return 0.0
        seen = _seen(rig, row, moment, before)
        if seen is not None:
            return seen - moment
        rig.pass_time(POLL)
    return None


def _seen(rig: Rig, row: Row, moment: float, before: dict[str, int]) -> float | None:
    if row.sign == "left":
        return _left(rig, moment)
    if row.sign.startswith("event:"):
        kind, _, key = row.sign.removeprefix("event:").partition(" ")
        reported = (
            e for e in rig.run.since(moment) if e["kind"] == kind and (not key or e.get(key))
        )
        return next((float(event["time"]) for event in reported), None)
    return _counted(rig, row, before)


def _left(rig: Rig, moment: float) -> float | None:
    """Return when compensating ended, by the loop's own word or by the end of its process."""
    for event in rig.run.since(moment):
        if event.get("from") == "COMPENSATING" or event["kind"] in ("fault", "failure"):
            return float(event["time"])
    return None


def _counted(rig: Rig, row: Row, before: dict[str, int]) -> float | None:
    names = row.sign.split("|")
    now = rig.run.memory.counts()
    return time.time() if any(now[name] > before[name] for name in names) else None


def _settle(rig: Rig, row: Row) -> str:
    """Return the state in which the daemon comes to rest without a person."""
    until = time.monotonic() + END_LIMIT
    since, state = time.monotonic(), rig.run.state
    while time.monotonic() < until:
        now = rig.run.state
        if now != state:
            since, state = time.monotonic(), now
        rests = state.name.lower() in row.end and state != State.HOLDING
        stays = time.monotonic() - since
        if (rests and stays > AFTERWARDS) or (state in RESTING and stays > AT_REST):
            break
        rig.pass_time(POLL)
    return state.name.lower()


def _missed(rig: Rig, first: int) -> int:
    """Return how many states the loop has missed since its cycle number ``first``."""
    memory = rig.run.memory
    rows, _ = memory.rows(first, memory.written)
    return int(rows[:, memory.slices["missed"].start].sum())


def _judge(rig: Rig, row: Row, detected: float | None, end: str, missed: int) -> list[str]:
    wrong = []
    limit = row.within(rig.link)
    if detected is None:
        wrong.append(f"not detected; the loop missed {missed} states ({rig.run.last_words()})")
    elif detected > limit:
        wrong.append(f"detected after {detected:.3f} s, allowed {limit:.3f}")
    if end not in row.end:
        wrong.append(f"ended {end}, expected {' or '.join(row.end)} ({rig.run.last_words()})")
    if rig.run.error is not None:
        wrong.append(f"the daemon ended: {rig.run.error}")
    return wrong
