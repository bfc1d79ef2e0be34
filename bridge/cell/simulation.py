"""The simulated controller of a cell: same arm and tool, hidden flexibilities of its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bridge.cell.cell import Cell
from core.errors import CellError
from core.rotation import rotation_vector
from drivers.simulated.settings import ServerSettings, simulated_cell

HOST = "127.0.0.2"
PORTS = ("rtde_port", "dashboard_port", "script_port", "bench_port")


def server_settings(cell: Cell, host: str | None = None, seed: int | None = None) -> ServerSettings:
    """Return the server of a cell's simulated controller.

    Its plant has the cell's arm, tool, payload and gravity; its flexibilities are drawn from the
    seed unless ``simulation.compliance`` gives them. The cell's own compliance and effects are what
    is believed of it, so they play no part. Raises CellError where the cell cannot be simulated.
    """
    simulation, link = cell.file.simulation, cell.file.link
    address = host or simulation.host or (link.host if link else HOST)
    if not address.startswith("127."):
        raise CellError(
            f"{cell.path}: simulation.host: found {address!r}, expected a loopback address "
            "(127.x.x.x): a simulated controller is never served to others"
        )
    chosen = {name: getattr(simulation, name) for name in PORTS}
    settings = simulated_cell(
        cell.arm,
        address,
        simulation.seed if seed is None else seed,
        simulation.start_q,
        **_plant(cell),
    )
    return replace(settings, **{name: port for name, port in chosen.items() if port is not None})


def _plant(cell: Cell) -> dict[str, Any]:
    simulation, model = cell.file.simulation, cell.model
    tool = model.tool_in_flange
    payload = simulation.payload or cell.file.payload
    fields: dict[str, Any] = {
        "tcp": (*_floats(tool[:3, 3]), *_floats(rotation_vector(tool[:3, :3]))),
        "payload_mass": payload.mass,
        "payload_cog": tuple(payload.cog),
        "gravity": _floats(model.gravity),
    }
    if simulation.tracker_noise is not None:
        fields["tracker_noise"] = simulation.tracker_noise
    if simulation.compliance is not None:
        for key in ("axial", "radial"):
            values = getattr(simulation.compliance, key)
            if values is None:
                continue
            if len(values) != cell.arm.n:
                raise CellError(
                    f"{cell.path}: simulation.compliance.{key}: found {len(values)} values, "
                    f"expected {cell.arm.n}"
                )
            fields[key] = tuple(values)
    return fields


def _floats(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
