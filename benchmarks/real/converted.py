"""A public data set as a log and a cell: what all converters share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.real import arms
from benchmarks.real.geometry import rough_tool

Array = NDArray[np.float64]
Columns = dict[str, Array]


@dataclass(frozen=True)
class Converted:
    """One log with its cell, and what is known of both."""

    columns: Columns
    cell: dict[str, Any]
    about: dict[str, Any]
    urdf: str | None = None


def cell_of(links: tuple[arms.Link, ...], **more: Any) -> dict[str, Any]:
    """Return a cell of an arm given by its rows, with further keys."""
    return {"robot": {"dh": [link.document() for link in links]}} | more


def tracker_of(sigma: float) -> dict[str, Any]:
    """Return the key ``metrology`` of an instrument somewhere, ``sigma`` in m."""
    return {"registered": False, "sigma": sigma}


def tool_of(point: Array, turn: Array | None = None) -> dict[str, Any]:
    """Return the key ``tool`` with a point (3,) and roll, pitch and yaw (3,)."""
    rpy = [0, 0, 0] if turn is None else [float(x) for x in turn]
    return {"tcp": {"xyz": [float(x) for x in point], "rpy": rpy}}


def poses_of(
    links: tuple[arms.Link, ...], q: Array, position: Array, sigma: float, about: dict[str, Any],
    point: Array | None = None, session: Array | None = None,
) -> Converted:  # fmt: skip
    """Return a log of measured poses; without a tool point the best for the nominal arm."""
    if point is None:
        first = slice(None) if session is None else session == session[0]
        point = rough_tool(links, q[first], position[first])
        about = about | {"tool": "the tool point is the best for the nominal arm, rounded to 1 mm"}
    columns = {"timestamp": np.arange(len(q)) * 30.0, "actual_q": q, "measured_position": position}
    columns |= {} if session is None else {"session": session}
    about = about | {
        "masses": "not known, left out",
        "timestamps": "only the order is known: 30 s steps were put in",
    }
    return Converted(
        columns, cell_of(links, tool=tool_of(point), metrology=tracker_of(sigma)), about
    )
