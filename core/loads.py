"""Loads on the arm per row: payload, external wrench, temperatures, direction of approach."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from numpy.typing import NDArray

from gapbridge.core.arrays import Array


@dataclass(frozen=True)
class Loads:
    """Loads of N rows; a field left None takes the model's own value (payload) or nothing."""

    payload_mass: Array | None = None  # (N,) kg
    payload_cog: Array | None = None  # (N, 3) m, flange axes
    wrench: Array | None = None  # (N, 6) N, Nm: surroundings on the tool, at the TCP, base axes
    temperature: Array | None = None  # (N, n) °C, joint temperatures
    approach: Array | None = None  # (N, n) sign of each joint's last motion: -1, 0, +1
    time: Array | None = None  # (N,) s, or numbers of rows; None: after all slips

    def __getitem__(self, rows: slice | NDArray[Any]) -> Loads:
        """Return the loads of some of the rows."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return Loads(**{k: None if v is None else v[rows] for k, v in given.items()})
