"""The half of a profile that goes out: setpoint, sequences, and the allow-list they obey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from gapbridge.drivers.can.names import Keys, Names
from gapbridge.drivers.can.profile import Action, CanProfile, Key, Outgoing
from gapbridge.drivers.can.schema import FrameEntry, Step


class OutgoingLoading:
    """What may be sent, put together from a profile's keys."""

    def __init__(self, names: Names) -> None:
        self.names, self.file = names, names.file

    def setpoint(self) -> tuple[Outgoing, ...]:
        """Return the frames of a setpoint in their order. Raises ProfileError."""
        entry = self.file.setpoint
        if entry is None:
            return ()
        keys: Keys = ("setpoint", "frames")
        owned: dict[str, list[tuple[str, int]]] = {}
        for i, full in enumerate(entry.position.signals):
            message, signal = self.names.signal(full, ("setpoint", "position", "signals", i))
            owned.setdefault(message.name, []).append((signal.name, i))
        names = [frame.message for frame in entry.frames]
        for name in owned:
            if names.count(name) != 1:
                raise self.names.error(
                    keys, f"found {name} {names.count(name)} times, expected once: joints are in it"
                )
        return tuple(
            self._frame(frame, (*keys, i), tuple(owned.get(frame.message, ())))
            for i, frame in enumerate(entry.frames)
        )

    def frames(self, entries: Sequence[FrameEntry], keys: Keys) -> tuple[Outgoing, ...]:
        """Return frames without joints. Raises ProfileError."""
        return tuple(self._frame(entry, (*keys, i)) for i, entry in enumerate(entries))

    def _frame(
        self, entry: FrameEntry, keys: Keys, joints: tuple[tuple[str, int], ...] = ()
    ) -> Outgoing:
        message, key = self.names.message(entry.message, (*keys, "message"))
        if entry.data is not None:
            return Outgoing(message.name, key, message, {}, self._bytes(entry.data, message, keys))
        known = {signal.name for signal in message.signals}
        for name in entry.signals:
            if name not in known:
                detail = f"found {name!r}, no signal of {message.name}: {', '.join(sorted(known))}"
                raise self.names.error((*keys, "signals", name), detail)
        filled = {name for name, _ in joints}
        if missing := known - filled - set(entry.signals):
            raise self.names.error(
                (*keys, "signals"), f"found no {sorted(missing)[0]}, expected its value"
            )
        frame = Outgoing(message.name, key, message, dict(entry.signals), None, joints)
        if not joints:
            try:
                return replace(frame, data=frame.encode())
            except ValueError as error:
                raise self.names.error((*keys, "signals"), str(error)) from None
        return frame

    def _bytes(self, text: str, message: Any, keys: Keys) -> bytes:
        try:
            data = bytes.fromhex(text)
        except ValueError:
            raise self.names.error((*keys, "data"), f"found {text!r}, expected hex bytes") from None
        if len(data) != message.length:
            raise self.names.error(
                (*keys, "data"), f"found {len(data)} bytes, expected {message.length}"
            )
        return data

    def actions(self, steps: Sequence[Step], key: str) -> tuple[Action, ...]:
        """Return the steps of a sequence. Raises ProfileError."""
        found = []
        for i, step in enumerate(steps):
            if step.until in ("enabled", "disabled") and self.file.enabled is None:
                raise self.names.error((key, i, "until"), "found no key `enabled` to show it")
            if step.hold and self.file.setpoint is None:
                raise self.names.error((key, i, "hold"), "found no key `setpoint` to hold with")
            frames = self.frames(step.send, (key, i, "send"))
            found.append(Action(frames, step.hold, step.wait, step.until, step.within, step.every))
        return tuple(found)

    def control(self, sends: frozenset[Key]) -> frozenset[Key]:
        """Return what only a commander sends; asking for feedback is no commanding."""
        further = frozenset(self.names.key(identifier) for identifier in self.file.control)
        asked = {self.names.message(frame.message, ("request",))[1] for frame in self.file.request}
        return (sends | further) - asked

    def check_sends(self, profile: CanProfile) -> None:
        """Refuse a frame that the allow-list does not have, and feedback that we would send."""
        groups: list[tuple[Keys, Sequence[Outgoing]]] = [
            (("request",), profile.request),
            (("setpoint", "frames"), profile.setpoint),
        ]
        for key in ("enable", "release", "stop"):
            groups += [((key, i), a.frames) for i, a in enumerate(getattr(profile, key))]
        for keys, frames in groups:
            for frame in frames:
                if frame.key not in profile.sends:
                    raise self.names.error(
                        keys,
                        f"found {frame.name} ({frame.key[0]:#x}), expected only identifiers that "
                        "`sends` lists",
                    )
        for i, identifier in enumerate(self.file.sends):
            incoming = profile.incoming.get(self.names.key(identifier))
            if incoming is not None:
                raise self.names.error(
                    ("sends", i), f"found {identifier:#x}, which is {incoming.name}, feedback"
                )
