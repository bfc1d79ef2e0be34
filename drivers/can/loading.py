"""A profile out of its YAML and its DBC, checked as a whole before anything touches a bus."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from gapbridge.core.arrays import Array
from gapbridge.drivers.can.dbc import Dbc, read_dbc
from gapbridge.drivers.can.loading_outgoing import OutgoingLoading
from gapbridge.drivers.can.names import Keys, Names
from gapbridge.drivers.can.profile import (
    CanProfile,
    Check,
    Incoming,
    JointMap,
    Key,
    Reading,
)
from gapbridge.drivers.can.schema import ProfileFile, Quantity
from gapbridge.drivers.profile_file import ProfileDocument, ProfileError, read_profile_document

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


def read_profile(path: Path, installation: Mapping[str, list[float]] | None = None) -> CanProfile:
    """Return the profile of a YAML file; raises ProfileError.

    ``installation`` replaces its direction, zero and gear.
    """
    document = read_profile_document(path)
    try:
        file = ProfileFile.model_validate(document.data)
    except ValidationError as error:
        raise _schema_error(document, error) from None
    file = file.model_copy(update=dict(installation or {}))
    return _Loading(document, file, read_dbc(path.parent / file.dbc)).profile()


def _schema_error(document: ProfileDocument, error: ValidationError) -> ProfileError:
    """Return one line; unknown keys first, since a misspelt key is also a missing one."""
    worst = min(error.errors(), key=lambda d: d["type"] != "extra_forbidden")
    keys = tuple(key for key in worst["loc"] if key != "list[constrained-float]")
    found = worst["input"] if not isinstance(worst["input"], dict | list) else "something else"
    if worst["type"] == "missing":
        text = "found nothing, expected this key"
    elif worst["type"] == "extra_forbidden":
        text = "found an unknown key"
    elif worst["type"] == "value_error":
        text = worst["msg"].removeprefix("Value error, ")
    else:
        text = f"found {found!r}, {worst['msg'][0].lower()}{worst['msg'][1:]}"
    return document.error(keys, text)


class _Loading:
    """One profile being put together."""

    def __init__(self, document: ProfileDocument, file: ProfileFile, dbc: Dbc) -> None:
        self.document, self.file, self.dbc = document, file, dbc
        self.names = Names(document, file, dbc)
        self.n = file.joints

    def profile(self) -> CanProfile:
        file = self.file
        joints = self._joints()
        out = OutgoingLoading(self.names)
        sends = frozenset(self.names.key(identifier) for identifier in file.sends)
        profile = CanProfile(
            name=file.name, path=str(self.document.path), n=self.n, rate=file.rate,
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
        given = file.gear if isinstance(file.gear, list) else [file.gear] * self.n
        gear = np.array(self._per_joint("gear", given, 1.0))
        if (gear == 0.0).any():
            raise self.names.error(("gear",), "found 0, expected a ratio that is not zero")
        zero = np.array(self._per_joint("zero", file.zero, 0.0))
        scale: dict[str, Array] = {}
        for name in ("position", "velocity", "torque", "temperature"):
            quantity: Quantity | None = getattr(feedback, name)
            if quantity is None:
                continue
            unit = self._units(quantity, name, ("feedback", name))
            by = {"torque": sign, "temperature": np.ones(self.n)}.get(name, sign / gear)
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

    def _per_joint(self, key: str, given: Sequence[float] | None, left_out: float) -> list[float]:
        if given is None:
            return [left_out] * self.n
        if len(given) != self.n:
            raise self.names.error((key,), f"found {len(given)} values, expected {self.n}")
        return [float(v) for v in given]

    def _units(self, quantity: Quantity, name: str, keys: Keys) -> Array:
        """Return SI in one wire unit (n,); checks that every joint is there, once."""
        if len(quantity.signals) != self.n:
            missing = f"joint {len(quantity.signals) + 1} is missing"
            missing = missing if len(quantity.signals) < self.n else "there are too many"
            raise self.names.error(
                (*keys, "signals"),
                f"found {len(quantity.signals)} signals, expected {self.n} (joints): {missing}",
            )
        factors = []
        for i, full in enumerate(quantity.signals):
            at: Keys = (*keys, "signals", i)
            message, signal = self.names.signal(full, at)
            if quantity.signals.index(full) != i:
                raise self.names.error(at, f"found {full} twice, expected one signal per joint")
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
            check = Check(
                signal.name, frozenset(entry.normal), dict(entry.values), entry.otherwise,
                entry.while_writing,
            )  # fmt: skip
            checks.setdefault(message.name, []).append(check)
        for i, full in enumerate(self.file.enabled.signals if self.file.enabled else ()):
            message, signal = self.names.signal(full, ("enabled", "signals", i))
            enabled.setdefault(message.name, []).append(signal.name)
        found: dict[Key, Incoming] = {}
        counted = [*self.file.sample.messages] if self.file.sample.counter else []
        for name in dict.fromkeys([*readings, *checks, *enabled, *counted]):
            message, key = self.names.message(name, self._place(name))
            found[key] = Incoming(
                name, key, message.length, message, tuple(readings.get(name, ())),
                tuple(checks.get(name, ())), tuple(enabled.get(name, ())),
                self._counter(message),
            )  # fmt: skip
        return found

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
        return counter

    def _check_sample(self, profile: CanProfile) -> None:
        """Refuse a sample without a joint's position, or with a message that says nothing."""
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
