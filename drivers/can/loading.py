"""Loading a profile from its YAML and its DBC, checked completely before a bus is opened."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.drivers.can.dbc import Dbc, read_dbc
from gapbridge.drivers.can.profile import (
    Action,
    CanProfile,
    Check,
    Incoming,
    JointMap,
    Key,
    Outgoing,
    Reading,
)
from gapbridge.drivers.can.schema import FrameEntry, ProfileFile, Quantity, Step
from gapbridge.drivers.profile_file import (
    ProfileDocument,
    ProfileError,
    read_profile_file,
)

Keys = tuple[str | int, ...]
TURN = 2.0 * math.pi
DEGREE = math.pi / 180.0
UNITS: dict[str, dict[str, float]] = {
    "position": {
        "rad": 1.0, "mrad": 1e-3, "deg": DEGREE, "°": DEGREE, "mdeg": 1e-3 * DEGREE,
        "turn": TURN, "turns": TURN, "rev": TURN,
    },
    "velocity": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": DEGREE, "°/s": DEGREE, "mdeg/s": 1e-3 * DEGREE,
        "turn/s": TURN, "turns/s": TURN, "rev/s": TURN, "rpm": TURN / 60.0,
    },
    "torque": {"Nm": 1.0, "N.m": 1.0, "mNm": 1e-3},
    "temperature": {"degC": 1.0, "°C": 1.0, "C": 1.0},
}  # fmt: skip
"""Quantity -> unit -> rad, rad/s, Nm or °C in one of it."""


class Names:
    """One profile's keys, those that a cell's link replaces, and its DBC's messages."""

    def __init__(
        self, document: ProfileDocument, file: ProfileFile, dbc: Dbc, replaced: frozenset[str]
    ) -> None:
        self.document, self.file, self.dbc, self.replaced = document, file, dbc, replaced

    def error(self, keys: Sequence[str | int], text: str) -> ProfileError:
        """Return an error with ``text`` about a key of the profile, or of the cell's link."""
        if keys[0] in self.replaced:
            return ProfileError(text, ("link", *keys))
        return self.document.error(keys, text)

    def message(self, name: str, keys: Keys) -> tuple[Any, Key]:
        """Return a message (cantools) and its identifier. Raises ProfileError."""
        message = self.dbc.messages.get(name)
        if message is None:
            raise self.error(
                keys, f"found {name!r}, no message of {self.dbc.path.name}{self.dbc.nearest(name)}"
            )
        return message, (message.frame_id, message.is_extended_frame)

    def signal(self, name: str, keys: Keys) -> tuple[Any, Any]:
        """Return message and signal (cantools) of ``MESSAGE.SIGNAL``. Raises ProfileError."""
        message_name, _, signal_name = name.partition(".")
        message = self.dbc.messages.get(message_name)
        for signal in message.signals if message else ():
            if signal.name == signal_name:
                if signal.multiplexer_ids is not None:
                    raise self.dbc.error(
                        message_name, signal_name,
                        "found a multiplexed signal, expected one that is in every frame",
                    )  # fmt: skip
                return message, signal
        raise self.error(
            keys, f"found {name!r}, no signal of {self.dbc.path.name}{self.dbc.nearest(name)}"
        )

    def key(self, identifier: int) -> Key:
        """Return an identifier with its length: 29 bits if the DBC or its value says so."""
        extended = identifier > 0x7FF or any(
            m.frame_id == identifier and m.is_extended_frame for m in self.dbc.messages.values()
        )
        return (identifier, extended)


class OutgoingLoading:
    """Builds the frames that may be sent from a profile's keys."""

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
        if joints and message.is_multiplexed():
            raise self.names.dbc.error(
                message.name, "", "found a multiplexed message, expected one for joints that is not"
            )
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
        result = []
        for i, step in enumerate(steps):
            if step.until in ("enabled", "disabled") and self.file.enabled is None:
                raise self.names.error((key, i, "until"), "found no key `enabled` to show it")
            if step.hold and self.file.setpoint is None:
                raise self.names.error((key, i, "hold"), "found no key `setpoint` to hold with")
            frames = self.frames(step.send, (key, i, "send"))
            result.append(Action(frames, step.hold, step.wait, step.until, step.within, step.every))
        return tuple(result)

    def control(self, sends: frozenset[Key]) -> frozenset[Key]:
        """Return the identifiers that only a commander sends.

        Requests for feedback are not, except on an identifier that also commands.
        """
        file = self.file
        declared = frozenset(self.names.key(identifier) for identifier in file.control)
        steps = [*file.enable, *file.release, *file.stop]
        entries = [
            *(file.setpoint.frames if file.setpoint else ()),
            *(f for s in steps for f in s.send),
        ]
        commands = {frame.message for frame in entries}
        requests = {
            self.names.message(frame.message, ("request",))[1]
            for frame in file.request
            if frame.message not in commands
        }
        return (sends - requests) | declared

    def check_sends(self, profile: CanProfile) -> None:
        """Refuse a frame that is not on the allow-list, and feedback that we would send."""
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


def read_profile(path: Path, installation: Mapping[str, list[float]] | None = None) -> CanProfile:
    """Return the profile of a YAML file; raises ProfileError.

    ``installation`` replaces its direction, zero and gear; errors in them have the link's keys.
    """
    document, file = read_profile_file(path, ProfileFile)
    replaced = dict(installation or {})
    file = file.model_copy(update=replaced)
    names = Names(document, file, read_dbc(path.parent / file.dbc), frozenset(replaced))
    return _Loading(names).profile()


class _Loading:
    """Builds one profile."""

    def __init__(self, names: Names) -> None:
        self.names, self.document, self.file, self.dbc = (
            names, names.document, names.file, names.dbc,
        )  # fmt: skip
        self.n = names.file.joints

    def profile(self) -> CanProfile:
        file = self.file
        joints = self._joints()
        out = OutgoingLoading(self.names)
        sends = frozenset(self.names.key(identifier) for identifier in file.sends)
        profile = CanProfile(
            name=file.name, n=self.n, rate=file.rate,
            incoming=self._incoming(), joints=joints,
            sample=tuple(
                self.names.message(name, ("sample", "messages", i))[1]
                for i, name in enumerate(file.sample.messages)
            ),
            window=file.sample.window, ordered=file.sample.ordered,
            counted=file.sample.counter is not None,
            enabled_values=frozenset(file.enabled.values if file.enabled else ()),
            status_timeout=file.status_timeout,
            request=out.frames(file.request, ("request",)), setpoint=out.setpoint(),
            enable=out.actions(file.enable, "enable"),
            release=out.actions(file.release, "release"),
            stop=out.actions(file.stop, "stop"), sends=sends,
            control=out.control(sends),
        )  # fmt: skip
        self._check_sample(profile)
        out.check_sends(profile)
        return profile

    # -- joints -----------------------------------------------------------------------------------

    def _joints(self) -> JointMap:
        file, feedback = self.file, self.file.feedback
        sign = np.array(self._per_joint("direction", file.direction, 1.0))
        gears = file.gear if isinstance(file.gear, list) else [file.gear] * self.n
        gear = np.array(self._per_joint("gear", gears, 1.0))
        if (gear == 0.0).any():
            raise self.names.error(("gear",), "found 0, expected a ratio that is not zero")
        zero = np.array(self._per_joint("zero", file.zero, 0.0))
        scale: dict[str, Array] = {}
        for name in ("position", "velocity", "torque", "temperature"):
            quantity: Quantity | None = getattr(feedback, name)
            if quantity is None:
                continue
            unit = self._units(quantity, name, ("feedback", name))
            by = {"torque": sign * np.sign(gear), "temperature": np.ones(self.n)}.get(
                name, sign / gear
            )
            scale[name] = unit * by
        if file.setpoint is None:
            return JointMap(scale, zero, None, None)
        keys: Keys = ("setpoint", "position")
        out = self._units(file.setpoint.position, "position", keys) * sign / gear
        counts = []
        for i, name in enumerate(file.setpoint.position.signals):
            _, signal = self.names.signal(name, (*keys, "signals", i))
            counts.append(0.0 if signal.conversion.is_float else float(signal.conversion.scale))
        return JointMap(scale, zero, out, np.abs(out * np.array(counts)))

    def _per_joint(self, key: str, values: Sequence[float] | None, left_out: float) -> list[float]:
        if values is None:
            return [left_out] * self.n
        if len(values) != self.n:
            raise self.names.error((key,), f"found {len(values)} values, expected {self.n}")
        return [float(v) for v in values]

    def _units(self, quantity: Quantity, name: str, keys: Keys) -> Array:
        """Return SI units per wire unit (n,); checks that each joint has one signal."""
        if len(quantity.signals) != self.n:
            missing = f"joint {len(quantity.signals) + 1} is missing"
            missing = missing if len(quantity.signals) < self.n else "there are too many"
            raise self.names.error(
                (*keys, "signals"),
                f"found {len(quantity.signals)} signals, expected {self.n} (joints): {missing}",
            )
        factors = []
        for i, full in enumerate(quantity.signals):
            signal_keys: Keys = (*keys, "signals", i)
            message, signal = self.names.signal(full, signal_keys)
            if quantity.signals.index(full) != i:
                raise self.names.error(
                    signal_keys, f"found {full} twice, expected one signal per joint"
                )
            unit = quantity.unit or signal.unit
            if unit in UNITS[name]:
                factors.append(UNITS[name][unit])
                continue
            known = ", ".join(UNITS[name])
            text = f"found unit {unit!r}, expected one of {known}"
            if quantity.unit:
                raise self.names.error((*keys, "unit"), text)
            raise self.dbc.error(message.name, signal.name, text)
        return np.array(factors)

    # -- incoming ---------------------------------------------------------------------------------

    def _incoming(self) -> dict[Key, Incoming]:
        readings: dict[str, list[Reading]] = {}
        checks: dict[str, list[Check]] = {}
        enabled: dict[str, list[str]] = {}
        for name in ("position", "velocity", "torque", "temperature"):
            quantity: Quantity | None = getattr(self.file.feedback, name)
            for i, full in enumerate(quantity.signals if quantity else ()):
                message, signal = self.names.signal(full, ("feedback", name, "signals", i))
                readings.setdefault(message.name, []).append(Reading(signal.name, name, i))
        for i, entry in enumerate(self.file.status):
            message, signal = self.names.signal(entry.signal, ("status", i, "signal"))
            if any(check.signal == signal.name for check in checks.get(message.name, ())):
                raise self.names.error(
                    ("status", i, "signal"), f"found {entry.signal} twice, expected one condition"
                )
            check = Check(
                signal.name, frozenset(entry.normal), dict(entry.values), entry.otherwise,
                entry.while_writing,
            )  # fmt: skip
            checks.setdefault(message.name, []).append(check)
        for i, full in enumerate(self.file.enabled.signals if self.file.enabled else ()):
            message, signal = self.names.signal(full, ("enabled", "signals", i))
            enabled.setdefault(message.name, []).append(signal.name)
        incoming: dict[Key, Incoming] = {}
        counted = [*self.file.sample.messages] if self.file.sample.counter else []
        for name in dict.fromkeys([*readings, *checks, *enabled, *counted]):
            message, key = self.names.message(name, self._place(name))
            incoming[key] = Incoming(
                name, key, message.length, message, tuple(readings.get(name, ())),
                tuple(checks.get(name, ())), tuple(enabled.get(name, ())),
                self._counter(message),
            )  # fmt: skip
        return incoming

    def _place(self, name: str) -> Keys:
        """Return where the profile names a message of its sample."""
        names = self.file.sample.messages
        return ("sample", "messages", names.index(name)) if name in names else ("feedback",)

    def _counter(self, message: Any) -> str | None:
        counter = self.file.sample.counter
        if counter is None or message.name not in self.file.sample.messages:
            return None
        if counter not in [signal.name for signal in message.signals]:
            raise self.names.error(
                ("sample", "counter"), f"found {counter!r}, no signal of {message.name}"
            )
        self.names.signal(f"{message.name}.{counter}", ("sample", "counter"))
        return counter

    def _check_sample(self, profile: CanProfile) -> None:
        """Refuse a sample without a joint's position, or with a message without signals."""
        names = self.file.sample.messages
        for i, name in enumerate(names):
            keys: Keys = ("sample", "messages", i)
            if names.index(name) != i:
                raise self.names.error(keys, f"found {name} twice, expected once")
            if profile.sample[i] not in profile.incoming:
                raise self.names.error(keys, f"found {name}, which carries no signal of a joint")
        for i, full in enumerate(self.file.feedback.position.signals):
            name = full.partition(".")[0]
            if name not in names:
                raise self.names.error(
                    ("sample", "messages"),
                    f"found no {name}, expected it: it carries the position of joint {i + 1}",
                )
        if profile.window * profile.rate > 1.0 + 1e-9:
            raise self.names.error(
                ("sample", "window"),
                f"found {profile.window:g} s, expected at most {1.0 / profile.rate:g} s (1 / rate)",
            )
