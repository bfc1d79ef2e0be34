"""One reading of a session, as the journal keeps it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_VECTORS = ("q", "value", "approach", "temperature", "wrench", "raw_wrench")


@dataclass(frozen=True)
class Taken:
    """What was measured at one stop."""

    stop: int  # number in the plan's poses, from 0
    q: Array  # (n,) rad
    value: Array  # (k,) SI, mean of the samples
    scatter: float  # m, 1 sigma of one coordinate of the mean; nan: not known
    samples: int  # averaged
    load: int
    station: int
    target: int
    approach: Array  # (n,) sign of each joint's last motion
    time: float = 0.0  # s, time.time()
    source: str = ""  # row or file of the instrument
    temperature: Array | None = None  # (n,) °C
    wrench: Array | None = None  # (6,) N, Nm: actual_TCP_force
    raw_wrench: Array | None = None  # (6,) N, Nm: ft_raw_wrench
    again: bool = False  # an earlier stop, measured once more
    doubted: bool = False  # kept by the person though it did not fit

    def entry(self) -> dict[str, Any]:
        """Return it for the journal, which gives it its time."""
        return {k: v for k, v in asdict(self).items() if v is not None and k != "time"}

    @classmethod
    def of(cls, entry: dict[str, Any]) -> Taken:
        """Return what an entry of the journal holds."""
        known = {k: v for k, v in entry.items() if k in cls.__dataclass_fields__}
        for name in _VECTORS:
            if name in known:
                known[name] = np.array([float(v) for v in known[name]])
        known["scatter"] = float(known["scatter"])
        return cls(**known)
