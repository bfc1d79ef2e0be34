"""A loaded profile: messages, joints and sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gapbridge.core.arrays import Array
from gapbridge.drivers.robot_modes import StopReason

Key = tuple[int, bool]  # identifier, whether it has 29 bits
Status = tuple[float, StopReason | None, bool]  # value, its meaning, counts only while writing


@dataclass(frozen=True, slots=True)
class Reading:
    """A signal that is one joint's part of a quantity."""

    signal: str
    quantity: str  # position, velocity, torque, temperature
    joint: int  # from 0


@dataclass(frozen=True, slots=True)
class Check:
    """A signal that reports whether the arm may be used."""

    signal: str
    normal: frozenset[int]
    values: dict[int, StopReason]
    otherwise: StopReason
    while_writing: bool = False  # counts only then

    def stop_reason(self, value: int) -> StopReason | None:
        """Return the meaning of a value; None if the arm may be used."""
        return None if value in self.normal else self.values.get(value, self.otherwise)


@dataclass(frozen=True, slots=True)
class Incoming:
    """A message that we read."""

    name: str
    key: Key
    length: int
    message: Any  # cantools
    readings: tuple[Reading, ...]
    checks: tuple[Check, ...]
    enabled: tuple[str, ...]  # signals
    counter: str | None

    def decode(self, data: bytes) -> dict[str, float]:
        """Return the signals. Raises ValueError where the bytes are not this message's."""
        if len(data) != self.length:
            raise ValueError(f"{self.name}: found {len(data)} bytes, expected {self.length}")
        try:
            signals: dict[str, float] = self.message.decode(data, decode_choices=False)
        except Exception as error:  # cantools, bitstruct and struct each raise their own
            raise ValueError(f"{self.name}: {error}") from None
        return signals


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A frame as it goes out; its bytes, or the signals that are constant in it."""

    name: str
    key: Key
    message: Any  # cantools
    constants: dict[str, float]
    data: bytes | None = None
    joints: tuple[tuple[str, int], ...] = ()  # signal, joint

    def encode(self, wire: Sequence[float] = ()) -> bytes:
        """Return the bytes, joints filled from ``wire`` (n). Raises ValueError."""
        if self.data is not None:
            return self.data
        values = dict(self.constants)
        for signal, joint in self.joints:
            values[signal] = wire[joint]
        try:
            return bytes(self.message.encode(values, strict=True))
        except Exception as error:  # cantools, bitstruct and struct each raise their own
            text = " ".join(str(error).split())
            raise ValueError(f"{self.name}: {text}") from None


@dataclass(frozen=True, slots=True)
class Action:
    """One step of a sequence."""

    frames: tuple[Outgoing, ...]
    hold: bool
    wait: float  # s
    until: str | None  # "enabled", "disabled", "ready"
    within: float  # s
    every: float  # s


@dataclass(frozen=True, slots=True)
class JointMap:
    """Wire <-> SI, all (n,): ``q = wire * scale[position] + zero``."""

    scale: dict[str, Array]
    zero: Array  # rad
    setpoint_scale: Array | None  # rad in one unit of the setpoint's signals
    resolution: Array | None  # rad, one count of the setpoint's signals

    def to_wire(self, q: Array) -> Array:
        """Return a setpoint (n,) in the wire's units."""
        assert self.setpoint_scale is not None
        return (q - self.zero) / self.setpoint_scale


@dataclass(frozen=True, slots=True)
class CanProfile:
    """One arm's map, checked."""

    name: str
    n: int
    rate: float  # Hz
    incoming: dict[Key, Incoming]
    joints: JointMap
    sample: tuple[Key, ...]
    window: float  # s
    ordered: bool
    counted: bool
    enabled_values: frozenset[int]
    status_timeout: float  # s
    request: tuple[Outgoing, ...]
    setpoint: tuple[Outgoing, ...]
    enable: tuple[Action, ...]
    release: tuple[Action, ...]
    stop: tuple[Action, ...]
    sends: frozenset[Key]  # allow-list
    control: frozenset[Key]  # identifiers that command the arm

    @property
    def quantities(self) -> frozenset[str]:
        """Return the quantities in the feedback."""
        return frozenset(self.joints.scale)

    @property
    def writes(self) -> bool:
        """Return whether setpoints can be sent."""
        return bool(self.setpoint)
