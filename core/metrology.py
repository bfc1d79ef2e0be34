"""The instrument that measured the TCP."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Metrology:
    """The instrument: its frame and its noise."""

    registered: bool = False  # True: measured_* are in base; False: their frame is estimated
    sigma: float = 2.0e-5  # m, 1 sigma of one coordinate, the instrument alone
    repeatability: float | None = None  # m, 1 sigma of one coordinate, of the arm; None: estimated
    remounted: bool = False  # True: each session has a separate tool point, estimated
