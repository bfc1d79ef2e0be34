"""The reading half: samples and another commander's frames from the frames of the bus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError, first_line
from gapbridge.drivers.can.assembler import Assembler, Sample
from gapbridge.drivers.can.profile import CanProfile, Key, Status
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.can_bus.bus import close_bus, is_own, open_bus
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.robot_modes import StopReason

QUEUED_CYCLES, QUEUED_TIME = 4.0, 0.03  # cycles, s: a sample queued for longer is not fresh
BACKLOG_TIME = 0.05  # s that reading queued frames may take


@dataclass(frozen=True, slots=True)
class ForeignCommand:
    """A frame that only a commander sends, and that we did not send."""

    key: Key
    seen: float  # s, monotonic


class FrameReader:
    """Reads one bus for one profile. Opens and closes it; independent of writing."""

    def __init__(self, settings: CanSettings, profile: CanProfile, clock: Clock) -> None:
        self._now = clock.monotonic
        self._settings, self._profile = settings, profile
        self.bus: Any = None
        self.assembler = Assembler(profile)
        self.foreign: ForeignCommand | None = None
        self.error_frames = 0
        self.identifiers: set[int] = set()  # received, for messages
        self._targets = {f.key: f for f in profile.setpoint if f.joints}
        self._motors = sum(len(incoming.enabled) for incoming in profile.incoming.values())
        self._longest = max(QUEUED_CYCLES / settings.rate, QUEUED_TIME)  # s
        self._empty = 0.0  # s, monotonic: when the queue was last empty
        self._foreign_wire = np.full(profile.n, np.nan)

    def open(self) -> None:
        """Open the bus, with kernel filters for the frames read, if possible. Raises LinkError.

        Elsewhere python-can filters, and then returns None for each foreign frame: reading a
        backlog would stop in the middle of it.
        """
        keys = set(self._profile.incoming) | set(self._profile.control)
        filters: Any = [
            {"can_id": key[0], "can_mask": 0x1FFFFFFF if key[1] else 0x7FF, "extended": key[1]}
            for key in sorted(keys)
        ]
        in_kernel = self._settings.interface == "socketcan"
        self.bus = open_bus(self._settings, filters if in_kernel else None)
        self._empty = self._now()

    def close(self) -> None:
        """Close the bus; may be repeated."""
        bus, self.bus = self.bus, None
        if bus is not None:
            close_bus(bus)

    def poll(self, timeout: float) -> Sample | None:
        """Take one frame that comes within ``timeout`` s; returns the sample it completes.

        Raises LinkError where the bus has gone.
        """
        frame = self._receive(timeout)
        if frame is None:
            return None
        return self._fresh(self._take(frame, self._now()), self._empty)

    def newest(self) -> Sample | None:
        """Read all queued frames; returns the newest complete sample of them."""
        newest, until = None, self._now() + BACKLOG_TIME
        empty = self._empty  # before all that is read now
        while (frame := self._receive(0.0)) is not None:
            now = self._now()
            newest = self._take(frame, now) or newest
            if now > until:
                break
        return self._fresh(newest, empty)

    def _fresh(self, sample: Sample | None, empty: float) -> Sample | None:
        """Return a sample; None if it may have been queued for too long, this process being late.

        ``empty`` (s, monotonic): when the queue was last empty before it arrived.
        """
        late = sample is not None and sample.received - empty > self._longest
        return None if late else sample

    def listen(self, seconds: float) -> Sample | None:
        """Take frames for a while; returns the newest complete sample of them."""
        newest, until = None, self._now() + seconds
        while (remaining := until - self._now()) > 0.0:
            newest = self.poll(min(remaining, 0.02)) or newest
        return newest

    def _receive(self, timeout: float) -> Any:
        if self.bus is None:
            raise LinkError(f"{self._settings.where()}: found no bus, expected connect() first")
        try:
            polled_at = self._now()
            if (frame := self.bus.recv(0.0)) is not None:
                return frame
            self._empty = polled_at
            return self.bus.recv(timeout) if timeout > 0.0 else None
        except Exception as error:  # CanError, OSError, serial's, or a broken text on the wire
            raise LinkError(f"{self._settings.where()}: {first_line(error)}") from None

    def _take(self, frame: Any, now: float) -> Sample | None:
        if frame.is_error_frame:
            self.error_frames += 1
            return None
        if frame.is_remote_frame or frame.is_fd or is_own(frame, self._settings):
            return None
        key = (frame.arbitration_id, frame.is_extended_id)
        self.identifiers.add(key[0])
        if key in self._profile.control:
            self.foreign = ForeignCommand(key, now)
            self._decode_foreign_target(key, bytes(frame.data))
            return None
        return self.assembler.take(key, bytes(frame.data), frame.timestamp or now, now)

    def _decode_foreign_target(self, key: Key, data: bytes) -> None:
        """Store the joints that another commander asks for."""
        target = self._targets.get(key)
        if target is None or len(data) != target.message.length:
            return
        try:
            values = target.message.decode(data, decode_choices=False)
        except Exception:  # another's frame that is none
            return
        for signal, joint in target.joints:
            self._foreign_wire[joint] = values[signal]

    def foreign_target(self, within: float) -> Array | None:
        """Return the joints (n,) that another commander asked for in the last ``within`` s, rad."""
        joints, foreign = self._profile.joints, self.foreign
        if foreign is None or joints.setpoint_scale is None:
            return None
        if self._now() - foreign.seen > within or not np.isfinite(self._foreign_wire).all():
            return None
        return self._foreign_wire * joints.setpoint_scale + joints.zero

    # -- status of the arm ------------------------------------------------------------------------

    @property
    def enabled(self) -> bool:
        """Return whether every motor reports that it is enabled."""
        motors = self.assembler.enabled
        return len(motors) == self._motors and all(motors.values())

    @property
    def disabled(self) -> bool:
        """Return whether every motor reports that it is not enabled."""
        motors = self.assembler.enabled
        return bool(motors) and not any(motors.values())

    def stop_reason(self, writing: bool) -> tuple[StopReason | None, str]:
        """Return why the arm cannot move and the signal that reports it; None where it can."""
        if not self.assembler.stopping:
            return None, ""
        return self._first_stop_reason(self.assembler.status, writing)

    def ended_stop_reason(self, writing: bool) -> StopReason | None:
        """Return a stop that has ended since ``clear_ended_stops``; None: there was none."""
        return self._first_stop_reason(self.assembler.ended_stops, writing)[0]

    def clear_ended_stops(self) -> None:
        """Drop stops that have ended: they were reported, or no state was read meanwhile."""
        self.assembler.ended_stops.clear()

    def _first_stop_reason(
        self, status: dict[tuple[Key, str], Status], writing: bool
    ) -> tuple[StopReason | None, str]:
        for (key, signal), (value, reason, only_writing) in status.items():
            if reason and (writing or not only_writing):
                name = self._profile.incoming[key].name
                return reason, f"{name}.{signal} is {value:g}"
        return None, ""

    def silent_status(self) -> str:
        """Return the name of a status message that is overdue; empty: none."""
        now, all_received = self._now(), self.assembler.received_at
        oldest = min(all_received.values(), default=0.0)
        complete = len(all_received) == len(self._profile.incoming)
        if complete and now - oldest <= self._profile.status_timeout:
            return ""
        for key, incoming in self._profile.incoming.items():
            received_at = self.assembler.received_at.get(key)
            if received_at is None or now - received_at > self._profile.status_timeout:
                return incoming.name
        return ""
