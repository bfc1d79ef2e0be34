"""One CAN frame as it goes over the simulated bus."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Frame:
    """A classic data frame: identifier, whether it has 29 bits, and up to eight bytes."""

    id: int
    data: bytes
    extended: bool = False

    def __post_init__(self) -> None:
        """Refuse what no CAN bus carries. Raises ValueError."""
        most = 0x1FFFFFFF if self.extended else 0x7FF
        if not 0 <= self.id <= most:
            raise ValueError(f"identifier: found {self.id:#x}, expected 0 to {most:#x}")
        if len(self.data) > 8:
            raise ValueError(f"data: found {len(self.data)} bytes, expected at most 8")
