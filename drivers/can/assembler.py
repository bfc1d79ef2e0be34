"""Frames -> samples: a sample is valid only if all its frames belong to one cycle.

All of its messages must arrive within the profile's window, none twice, in order if the profile
requires it, and with the same count if they have one. Everything else is dropped and counted.

Without order or count, only the window relates the frames. It fails if frames are delayed and then
arrive in a burst (an adapter that stamps on delivery, a late arm): with a frame lost, two cycles
can fill one window. Such a sample differs in its order: the lost frame comes last. Drifting nodes
change their order too, but each keeps its own period.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.drivers.can.profile import CanProfile, Incoming, Key, Status

QUANTITIES = ("position", "velocity", "torque", "temperature")
UNSTEADY = 0.3  # periods: six setpoint frames delay a frame by 3.1 of 10 ms at 250 kbit/s


class Sample(NamedTuple):
    """One complete sample, SI units; (n,) each, NaN where a joint has not reported yet.

    A tuple, because one is created in every cycle.
    """

    position: Array  # rad
    others: dict[str, Array]  # velocity rad/s, torque Nm, temperature °C
    stamp: float  # s, clock of the bus, of its last frame
    received: float  # s, time.monotonic() of its last frame
    began: float  # s, time.monotonic() of its first frame


class Assembler:
    """Takes frames one by one and returns a sample whenever one is complete."""

    def __init__(self, profile: CanProfile) -> None:
        self._profile = profile
        self._members = frozenset(profile.sample)
        self._names = [name for name in QUANTITIES if name in profile.quantities]
        self._rows = {name: k for k, name in enumerate(self._names)}
        joints = profile.joints
        self._scale = np.array([joints.scale[name] for name in self._names])
        self._zero = np.zeros_like(self._scale)
        self._zero[0] = joints.zero
        self._wire = np.full_like(self._scale, np.nan)  # (q, n): last values, the wire's units
        self._frames: dict[Key, dict[str, float]] = {}
        self._first = 0.0  # s, bus clock
        self._began = 0.0  # s, monotonic
        self._count: float | None = None
        self._tied = profile.ordered or profile.counted or bool(profile.request)
        self._last_stamps: dict[Key, float] = {}  # s, bus clock: last frame of each message
        self._steady = True  # each frame of the present sample came one period after its last one
        self._order: list[Key] = []  # of the last sample
        self._sample_stamp = -math.inf  # s, bus clock: that sample's last frame
        self.dropped: Counter[str] = Counter()  # reason -> frames or sets
        self.status: dict[tuple[Key, str], Status] = {}
        self.enabled: dict[tuple[Key, str], bool] = {}
        self.received_at: dict[Key, float] = {}  # s, monotonic, of each message that we read
        self.stopping: set[tuple[Key, str]] = set()  # members of ``status`` that report a stop
        self.ended_stops: dict[tuple[Key, str], Status] = {}  # the last status before the end
        self._last_bytes: dict[Key, bytes] = {}  # last bytes of messages outside the sample

    @property
    def broken(self) -> int:
        """Return how often frames formed no sample."""
        return self.dropped.total()

    @property
    def missing(self) -> list[str]:
        """Return the messages that the present sample lacks; empty if none has begun."""
        if not self._frames:
            return []
        return [
            self._profile.incoming[k].name for k in self._profile.sample if k not in self._frames
        ]

    def reset(self) -> None:
        """Discard the present incomplete sample."""
        self._frames.clear()

    def take(self, key: Key, data: bytes, stamp: float, received: float) -> Sample | None:
        """Take one frame; returns the sample that it completes. Raises nothing.

        ``stamp`` (s) is the bus's clock, ``received`` (s) ours.
        """
        incoming = self._profile.incoming.get(key)
        if incoming is None:
            return None
        if self._last_bytes.get(key) == data:  # unchanged, as most status messages are
            self.received_at[key] = received
            return None
        try:
            values = incoming.decode(data)
        except ValueError:
            self.dropped["malformed"] += 1
            return None
        self.received_at[key] = received
        if incoming.checks or incoming.enabled:
            self._note(incoming, values)
        if key in self._members:
            return self._collect(incoming, values, stamp, received)
        self._last_bytes[key] = data
        self._read(incoming, values)
        return None

    def _note(self, incoming: Incoming, values: dict[str, float]) -> None:
        """Store what a message reports about the arm's status."""
        for check in incoming.checks:
            value = values[check.signal]
            reason = check.stop_reason(int(value)) if math.isfinite(value) else check.otherwise
            place = (incoming.key, check.signal)
            if reason:
                self.stopping.add(place)
            elif place in self.stopping:
                self.stopping.discard(place)
                self.ended_stops[place] = self.status[place]
            self.status[place] = (value, reason, check.while_writing)
        for signal in incoming.enabled:
            self.enabled[incoming.key, signal] = values[signal] in self._profile.enabled_values

    def _read(self, incoming: Incoming, values: dict[str, float]) -> None:
        for reading in incoming.readings:
            self._wire[self._rows[reading.quantity], reading.joint] = values[reading.signal]

    def _collect(
        self, incoming: Incoming, values: dict[str, float], stamp: float, received: float
    ) -> Sample | None:
        profile, key = self._profile, incoming.key
        if self._frames and self._breaks(incoming, values, stamp):
            self.dropped["torn"] += 1
            self._frames.clear()
        if profile.ordered and profile.sample[len(self._frames)] != key:
            self.dropped["out of order"] += 1
            self._frames.clear()
            return None
        if not self._frames:
            self._first, self._began, self._steady = stamp, received, True
        self._frames[key] = values
        since, self._last_stamps[key] = stamp - self._last_stamps.get(key, -math.inf), stamp
        self._steady &= abs(since * profile.rate - 1.0) <= UNSTEADY
        if len(self._frames) < len(self._members):
            return None
        frames, self._frames = self._frames, {}
        if incoming.counter is not None:
            if values[incoming.counter] == self._count:
                self.dropped["repeated"] += 1
                return None
            self._count = values[incoming.counter]
        if not self._tied and self._may_mix_cycles(list(frames), stamp):
            self.dropped["out of order"] += 1
            return None
        for member, signals in frames.items():
            self._read(profile.incoming[member], signals)
        return self._sample(stamp, received)

    def _breaks(self, incoming: Incoming, values: dict[str, float], stamp: float) -> bool:
        """Return whether a frame cannot belong to the present sample."""
        if incoming.key in self._frames or not 0.0 <= stamp - self._first <= self._profile.window:
            return True
        if self._profile.ordered and self._profile.sample[len(self._frames)] != incoming.key:
            return True
        counter = incoming.counter
        if counter is None:
            return False
        count = values[counter]
        return any(v[counter] != count for v in self._frames.values())

    def _may_mix_cycles(self, order: list[Key], stamp: float) -> bool:
        """Return whether a complete sample may mix two cycles: another order, off the cadence.

        An order is kept for ``status_timeout``: after it the arm may have restarted.
        """
        remembered = 0.0 <= stamp - self._sample_stamp <= self._profile.status_timeout
        if remembered and order != self._order and not self._steady:
            return True
        self._order, self._sample_stamp = order, stamp
        return False

    def _sample(self, stamp: float, received: float) -> Sample:
        table = self._wire * self._scale + self._zero
        others = dict(zip(self._names[1:], table[1:], strict=True))
        return Sample(table[0], others, stamp, received, self._began)
