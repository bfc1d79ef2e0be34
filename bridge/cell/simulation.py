"""The simulated controller of a cell: same arm and tool, other (hidden) flexibilities.

UR controllers have one server; other protocols are served around an ArmController.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pkgutil import resolve_name
from typing import Any, NamedTuple

import numpy as np

from gapbridge.bridge.cell.agreement import SIMULATED_PORTS
from gapbridge.bridge.cell.cell import Cell
from gapbridge.bridge.cell.robot import calibration_of
from gapbridge.core.errors import InputError
from gapbridge.core.rotation import rotation_vector
from gapbridge.drivers.addresses import is_loopback
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.link_settings import DriverSettings
from gapbridge.drivers.simulated.ft_sensor.serving import served_sensor
from gapbridge.drivers.simulated.server.arm_controller import ArmController, make_controller
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer, serve_controller
from gapbridge.drivers.simulated.ur.server import serve
from gapbridge.drivers.simulated.ur.settings import (
    BENCH_PORT,
    ServerSettings,
    announced_rows,
    simulated_arm,
    simulated_cell,
)

HOST = "127.0.0.2"
PERIOD = 0.004  # s, cycle of an ArmController

SIMULATORS: dict[str, str] = {
    "can": "gapbridge.drivers.simulated.can.server:make_servers",
    "canopen": "gapbridge.drivers.simulated.canopen.server:make_servers",
    "modbus": "gapbridge.drivers.simulated.modbus.server:make_servers",
}
"""link.driver -> ``module:function(link, host, controller)``, which returns its ProtocolServers."""


class ServedController(NamedTuple):
    """The controller of a cell with its servers, not started."""

    controller: ArmController
    servers: list[ProtocolServer]
    host: str
    bench_port: int


def serve_cell(
    cell: Cell,
    host: str | None,
    seed: int | None,
    stop: Callable[[], bool],
    emit: Callable[[str], None],
    clock: Clock,
) -> None:
    """Serve the simulated controller of a cell until ``stop()`` is true.

    ``emit`` is called with the addresses it listens on. Raises CellError if the cell cannot be
    simulated, LinkError if a port is in use.
    """
    link = cell.link
    if link is not None and link.driver in SIMULATORS:
        served = served_controller(cell, link, host, seed)
        names = ", ".join(server.name for server in served.servers)
        emit(f"{cell.arm.name} at {served.host}: {names}, control port {served.bench_port}")
        with served_sensor(cell.ft_sensor, lambda: served.controller.raw_wrench, clock, link):
            serve_controller(
                served.controller, served.servers, served.host, served.bench_port, clock, stop
            )
        return
    settings = server_settings(cell, host, seed)
    emit(
        f"{settings.arm.name} at {settings.host}: RTDE {settings.rtde_port}, dashboard "
        f"{settings.dashboard_port}, primary {settings.primary_port}, scripts "
        f"{settings.script_port}, control port {settings.bench_port}"
    )
    serve(
        settings, clock, stop,
        lambda in_flange: served_sensor(cell.ft_sensor, in_flange, clock),
    )  # fmt: skip


def served_controller(
    cell: Cell, link: DriverSettings, host: str | None = None, seed: int | None = None
) -> ServedController:
    """Return the controller and the servers of a cell whose driver is not ur_rtde.

    For its plant see ``server_settings``. Raises CellError.
    """
    simulation, address = cell.file.simulation, _address(cell, host)
    arm, plant, start = simulated_arm(
        cell.arm, simulation.seed if seed is None else seed, simulation.start_q, **_plant(cell)
    )
    controller = make_controller(arm, plant, start, PERIOD)
    make_servers = resolve_name(SIMULATORS[str(getattr(link, "driver", ""))])
    servers = make_servers(link, address, controller)
    return ServedController(controller, servers, address, simulation.bench_port or BENCH_PORT)


def _address(cell: Cell, host: str | None) -> str:
    """Return the loopback address that the controller is served at. Raises InputError."""
    linked = getattr(cell.file.link, "host", None)
    address = host or cell.file.simulation.host or str(linked or HOST)
    if is_loopback(address):
        return address
    expected = "expected a loopback address (127.x.x.x): a simulated controller is never served to "
    if host is not None:
        raise InputError(f"--host: found {address!r}, {expected}others")
    raise cell.error(
        ("simulation", "host"), f"found nothing, and {address!r} at link.host, {expected}others"
    )


def server_settings(cell: Cell, host: str | None = None, seed: int | None = None) -> ServerSettings:
    """Return the server of a cell's simulated controller.

    Its plant has the cell's arm, tool, payload and gravity; its flexibilities are drawn from the
    seed unless ``simulation.compliance`` sets them. Compliance and effects of the cell's model are
    estimates and not part of the plant. Raises CellError if the cell cannot be simulated.
    """
    simulation, address = cell.file.simulation, _address(cell, host)
    ports = {name: getattr(simulation, name) for name in SIMULATED_PORTS}
    settings = simulated_cell(
        cell.arm,
        address,
        simulation.seed if seed is None else seed,
        simulation.start_q,
        **_plant(cell),
    )
    robot = cell.file.robot
    if robot.model is not None:
        deltas = calibration_of(robot.calibration, cell.path.parent)
        settings = replace(settings, calibrated=announced_rows(robot.model, deltas))
    else:
        settings = replace(settings, nominal=(), calibrated=())  # a UR reports built-in arms only
    return replace(settings, **{name: port for name, port in ports.items() if port is not None})


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
    if simulation.tool_shift is not None:
        fields["tool_shift"] = tuple(simulation.tool_shift)
    per_joint = {"droop": simulation.droop, "zero": simulation.zero}
    if (compliance := simulation.compliance) is not None:
        per_joint |= {"axial": compliance.axial, "radial": compliance.radial}
    fields |= {key: tuple(values) for key, values in per_joint.items() if values is not None}
    return fields


def _floats(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
