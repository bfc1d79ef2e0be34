"""The writing half: sends only frames that the profile allows, and only whole setpoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import PartialWriteError, WriteError, first_line
from gapbridge.drivers.can.profile import Action, CanProfile, Key, Outgoing
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import Clock

Frames = list[tuple[Key, bytes]]
Hold = Callable[[], Array | None]  # joints (n,), rad, of a hold step; None: nothing is to be held


class FrameWriter:
    """Sends setpoints and sequences over a bus that is open."""

    def __init__(self, settings: CanSettings, profile: CanProfile, clock: Clock) -> None:
        self._now = clock.monotonic
        self._settings, self._profile = settings, profile
        self._bus: Any = None
        self._last: Frames | None = None  # the last setpoint that was sent completely
        self.target: Array | None = None  # rad, the same as joints
        self.reverted = 0  # setpoints that were sent in part and reverted

    def use(self, bus: Any) -> None:
        """Send over this bus from now on; None: there is none any more."""
        self._bus = bus

    def reset(self) -> None:
        """Drop the last setpoint: the arm does not hold it any more."""
        self._last = self.target = None

    def write(self, q: Array) -> None:
        """Send one setpoint (n,), rad: all its frames, or the previous setpoint again.

        Raises WriteError; then the previous setpoint, or else the stop sequence, was sent after
        the partial one, unless the bus accepts no frame, which the message says.
        """
        frames = self._encode(q)
        for sent, (key, data) in enumerate(frames):
            try:
                self._send(key, data)
            except WriteError as error:
                done = self._revert() if sent else "nothing of it was sent"
                message = f"{error} ({sent} of {len(frames)} frames out; {done})"
                raise PartialWriteError(message) from None
        self._last, self.target = frames, q.copy()

    def _revert(self) -> str:
        """Replace a setpoint that was sent in part; returns what was done."""
        self.reverted += 1
        for frames, message in (
            (self._last, "the setpoint before was sent again"),
            (self._stop_frames(), "the stop sequence was sent"),
        ):
            if not frames:
                continue
            try:
                for key, data in frames:
                    self._send(key, data)
            except WriteError:
                continue
            return message
        return "neither the setpoint before nor a stop could be sent"

    def _stop_frames(self) -> Frames:
        return [(f.key, f.encode()) for action in self._profile.stop for f in action.frames]

    def _encode(self, q: Array) -> Frames:
        """Return all frames before any is sent. Raises WriteError."""
        if q.shape != (self._profile.n,) or not np.isfinite(q).all():
            raise WriteError(f"{self._profile.name}: found {q}, expected finite joints")
        wire: list[float] = self._profile.joints.to_wire(q).tolist()
        try:
            return [(f.key, f.encode(wire)) for f in self._profile.setpoint]
        except ValueError as error:
            raise WriteError(f"{self._profile.name}: {error}") from None

    def request(self) -> None:
        """Ask an arm that speaks only when spoken to. Raises WriteError."""
        for frame in self._profile.request:
            self._send(frame.key, frame.encode())

    def run(
        self,
        actions: Sequence[Action],
        hold: Hold,
        listen: Callable[[float], object],
        reached: Callable[[str], bool],
    ) -> None:
        """Go through a sequence. Raises WriteError where a frame or an ``until`` fails.

        ``hold`` returns the joints of a hold step, ``listen(s)`` reads for s seconds, ``reached``
        returns whether an ``until`` is fulfilled.
        """
        for action in actions:
            end = self._now() + action.within
            while True:
                self._do(action, hold)
                listen(action.wait if action.until is None else action.every)
                if action.until is None or reached(action.until):
                    break
                if self._now() > end:
                    names = ", ".join(f.name for f in action.frames) or "hold"
                    raise WriteError(
                        f"{self._profile.name}: {names}: not {action.until} after "
                        f"{action.within:g} s"
                    )

    def _do(self, action: Action, hold: Hold) -> None:
        for frame in action.frames:
            self._send(frame.key, self._bytes_of(frame))
        if action.hold and (q := hold()) is not None:
            self.write(q)

    def _bytes_of(self, frame: Outgoing) -> bytes:
        try:
            return frame.encode()
        except ValueError as error:
            raise WriteError(f"{self._profile.name}: {error}") from None

    def _send(self, key: Key, data: bytes) -> None:
        """Send one frame that the allow-list has. Raises WriteError."""
        import can

        if key not in self._profile.sends:
            raise WriteError(f"{self._profile.name}: {key[0]:#x} is not among the profile's sends")
        if self._bus is None:
            raise WriteError(f"{self._settings.where()}: found no bus, expected connect() first")
        frame = can.Message(arbitration_id=key[0], is_extended_id=key[1], data=data)
        try:
            self._bus.send(frame, timeout=self._settings.send_timeout)
        except Exception as error:  # CanError, OSError, serial's
            raise WriteError(
                f"{self._settings.where()}: frame {key[0]:#x} could not be sent: "
                f"{first_line(error)}"
            ) from None
