"""What must hold in every run, one list; each has a test that breaks the product and finds it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults.invariants import Checker
from benchmarks.faults.wire.seen import Fresh, Numbers, Write
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.link_monitor import hold_time
from gapbridge.bridge.loop.supervisor import CLEARED_BY_RECONNECTING, TRANSITIONS, Cause
from gapbridge.core.state import ENVELOPE, JOINT_LIMIT, JOINT_OFFSET, Setpoint

LONGEST_LIMITED = 2.5  # s: a second, anew where the controller's clock goes back
MARGIN = 0.01  # s: a cycle of the controller and what computing takes
GROWN = 5e-3  # s by which a way may have grown since the last round trip, unseen
LONGEST_LIST = 20
AT_LIMIT = 1 << ENVELOPE | 1 << JOINT_OFFSET | 1 << JOINT_LIMIT  # of "clamped"

INVARIANTS: dict[str, str] = {
    "envelope": "no offset on the wire is larger than the cell's, counted from where the arm was "
    "wanted before the first stream, over restarts and deaths of processes",
    "rate": "no offset on the wire changes faster than at the cell's rates, nor by a step",
    "start": "a stream of joints begins where the arm stands",
    "limits": "no joint setpoint is outside the joint limits, or no number",
    "allowed": "nothing leaves but what the driver's list allows, whole, with its checksum",
    "state": "setpoints leave in the states compensating and holding only",
    "stopped": "nothing is written to a robot that has said that it must not move",
    "fresh": "behind each write is a state that came at most 40 ms or five cycles before it, and "
    "there are never more writes than states",
    "age": "a state behind a write was sampled by the controller at most that long before",
    "asked": "writing begins after a person has asked for it, anew after each time that it ended",
    "latched": "a fault that does not end with its link stays until a person has acknowledged it, "
    "over the deaths of all processes",
    "table": "the state changes as the table of states says, and in no other way",
    "taken": "what a person asks for is taken by a loop, and what is answered is so",
    "ends": "a stop ends in time, and with a summary",
    "crash": "no process ends by an exception that is none of the product's",
    "recorded": "the cycles handed to the recorder say of each setpoint whether it left",
    "files": "each cycle is in a file of the recording or reported as lost, whatever disk and "
    "recorder do; a power cut, and a recorder that dies without a daemon, take the last second at "
    "most",
    "kept": "a cell file that is wrong ends no motion, and changes nothing",
    "saturated": "an offset does not stay at its limit: the motion ends",
    "sensor": "behind no setpoint is a force whose sample came longer ago than it may be old",
    "recovers": "once robot, network and machine are healed, a person can arm again",
}


@dataclass(frozen=True)
class Violation:
    """One invariant that did not hold."""

    invariant: str
    time: float  # s since the begin of the run
    words: str

    def __str__(self) -> str:
        return f"{self.invariant} at {self.time:.4f} s: {self.words}"


_KINDS = (
    ("allowed", r"(broken|forbidden) write"),
    ("state", r"write in state"),
    ("stopped", r"must not move"),
    ("fresh", r"last fresh state|before any state|more writes than states"),
    ("start", r"a stream began"),
    ("limits", r"outside its limits|nan|inf"),
    ("envelope", r", allowed"),
    ("rate", r"at once|within"),
)
"""What benchmarks/faults/invariants.py says -> which invariant that is."""


class Judge:
    """Watches a run; ``violations`` are what it has found."""

    def __init__(self, checker: Checker, begin: float, rate: float) -> None:
        self.violations: list[Violation] = []
        self._checker, self._begin = checker, begin
        self._known = 0
        self._now = begin
        self._most_age = hold_time(rate) + MARGIN
        self._asked = False  # since writing ended last
        self._acknowledged = False  # since the fault began
        self._fault: str | None = None  # that is latched
        self._heals = False
        self._in_order = True  # the last daemon ended so
        self._to_end = False  # somebody wants the motion to end, since it began
        self._stops = False  # the daemon has been asked to end, armed anew or not
        self._reloads = False  # a cell file was taken; the loop ends for it, armed anew or not
        self._configuration = ""  # hash of the cell file that was taken last
        self._last: Numbers = ()  # the values of the last write
        self.writes_noted = 0  # setpoints seen on the wire
        self.oldest = 0.0  # s
        self.hidden = 0.0  # s, oldest state whose age nothing could show; 0 where there was none

    def violate(self, invariant: str, words: str) -> None:
        """Note that an invariant did not hold."""
        assert invariant in INVARIANTS, invariant
        if len(self.violations) < LONGEST_LIST:
            self.violations.append(Violation(invariant, self._now - self._begin, words))

    # -- the wire ---------------------------------------------------------------------------------

    def saw(self, seen: Fresh | Write) -> None:
        """Take what goes over the wire, as it does."""
        self._now = seen.time
        checker = self._checker
        if self._lets_go(seen):
            return
        checker.take([seen])
        if checker.suspected:  # the loop's state is known exactly here
            write = checker.suspected.pop()
            checker.suspected.clear()
            self.violate("state", f"write in state {State(write.state).name}")
        if isinstance(seen, Write) and seen.kind in ("offset", "joints"):
            self.writes_noted += 1
            self._last = seen.values
        found = checker.found
        if found.violated > self._known:
            for words in found.violations[self._known - found.violated :]:
                self.violate(_kind_of(words), words.split(" [")[0])
            self._known = found.violated

    def _lets_go(self, seen: Fresh | Write) -> bool:
        """Return whether joints only say again where the arm was sent: the motion ends."""
        again = isinstance(seen, Write) and seen.kind == "joints" and seen.values == self._last
        return again and State(seen.state) is not State.COMPENSATING

    def sent(
        self, setpoint: Setpoint, sampled: float, now: float, hidden_leap: float = 0.0
    ) -> None:
        """Take a setpoint as it is handed to the driver, and when its state was sampled, s.

        ``hidden_leap``: s by which the controller's clock was set while nothing could show it.
        """
        self._now = now
        if math.isnan(sampled):
            self.violate("age", "a setpoint of a state that no controller has sampled")
            return
        age = now - sampled
        most = self._most_age + GROWN
        if most < age <= most + hidden_leap:
            self.hidden = max(self.hidden, age)
            return
        self.oldest = max(self.oldest, age)
        if age > most:
            self.violate("age", f"a setpoint of a state sampled {age:.3f} s before")

    # -- what the daemon reports ------------------------------------------------------------------

    def on_event(self, event: dict[str, Any]) -> None:
        """Take an event of the daemon's log."""
        self._now = float(event["seen"])
        kind = event["kind"]
        if kind == "request":
            if event["command"] == "arm" and event["by"] == "the cell file" and not self._in_order:
                self.violate("asked", "the cell file arms after a daemon has died")
            self._asked |= event["command"] == "arm"
            self._to_end |= event["command"] == "disarm"
            self._acknowledged |= event["command"] == "disarm"
        elif kind == "transition":
            self._changed(State[event["from"]], State[event["to"]], Cause(event["cause"]))
        elif kind == "configuration":
            self._read_again(event["ok"], event["hash"])
        elif kind in ("failure", "fault") and self._heals:
            self._fault = None  # the link has ended, and such a fault with it

    def stops(self) -> None:
        """Note that the daemon has been asked to end."""
        self._stops = True

    def begins(self, configuration: str, in_order: bool, is_noted: bool) -> None:
        """Note that a daemon begins, with which cell file (its hash), and how the last one ended.

        A person who starts it again after it ended in order knows of its faults. ``is_noted``: the
        last one's note is there, which a power cut takes with it.
        """
        self._configuration, self._in_order = configuration, in_order
        self._asked = self._acknowledged = self._stops = False
        if in_order or not is_noted:
            self._fault = None

    def _read_again(self, fine: bool, configuration: str) -> None:
        if not fine and configuration != self._configuration:
            self.violate("kept", "the cell file that was refused is in use")
        self._configuration = configuration
        self._reloads |= fine

    def judge_limited(self, rows: NDArray[np.float64], slices: dict[str, slice]) -> None:
        """Judge how long offsets were at their limits, by the cycles of a daemon."""
        since = math.nan
        columns = [rows[:, slices[name].start] for name in ("state", "clamped", "received")]
        for state, clamped, received in zip(*(c.tolist() for c in columns), strict=True):
            if state != State.COMPENSATING or not int(clamped) & AT_LIMIT:
                since = math.nan
                continue
            since = received if math.isnan(since) else since
            if received - since > LONGEST_LIMITED:
                self.violate("saturated", f"at its limit for {received - since:.2f} s")
                return

    def has_wrench(self, age: float, most: float) -> None:
        """Take how long before a state its sensor's last sample had come, and may have, s."""
        if age > most + MARGIN:
            self.violate("sensor", f"a force that came {age:.3f} s before")

    def _changed(self, before: State, after: State, cause: Cause) -> None:
        if TRANSITIONS.get((before, cause)) != after:
            self.violate("table", f"{before.name} -> {after.name} by {cause}")
        if before == State.DISCONNECTED:
            self._reloads = False
        if cause in (Cause.DISARM, Cause.STOP) and not (
            self._to_end or self._stops or self._reloads
        ):
            self.violate("kept", f"{before.name} -> {after.name} by {cause}: nobody wanted that")
        if after == State.ARMED:
            self._to_end = False
            if not self._asked:
                self.violate("asked", "armed without anybody having asked")
            self._asked = False
        if after == State.COMPENSATING and before not in (State.ARMED, State.HOLDING):
            self.violate("asked", f"{before.name} -> {after.name}")
        if after == State.FAULT:
            if cause != Cause.LATCHED:
                self._fault, self._heals = f"{cause}", cause in CLEARED_BY_RECONNECTING
                self._acknowledged = False
        elif before == State.FAULT:
            if after == State.OBSERVING and not self._acknowledged:
                self.violate("latched", f"{self._fault} was left by {cause}, not acknowledged")
            if after == State.OBSERVING:
                self._fault = None
            if after == State.DISCONNECTED and self._heals:
                self._fault = None
        elif self._fault is not None and not self._heals and after in (State.ARMED,):
            self.violate("latched", f"{self._fault} waits to be acknowledged, and it was armed")


def _kind_of(words: str) -> str:
    return next((name for name, pattern in _KINDS if re.search(pattern, words)), "limits")


def as_markdown() -> str:
    """Return the list as it stands in docs/evidence/fault-method.md."""
    return "\n".join(f"- **{name}**: {words}" for name, words in INVARIANTS.items())
