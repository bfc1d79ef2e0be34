"""Values of a cell that must agree with its arm, or with each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from itertools import combinations

import numpy as np

from gapbridge.bridge.cell.schema import CellFile, Simulation
from gapbridge.core.arm import Arm
from gapbridge.core.plausibility import MAX_LIMIT, Implausible
from gapbridge.drivers.addresses import is_loopback
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

ALL_ADDRESSES = ("0.0.0.0", "::")
SIMULATED_PORTS = ("rtde_port", "dashboard_port", "script_port", "bench_port", "primary_port")


def disagreeing_values(file: CellFile, arm: Arm) -> Iterator[Implausible]:
    """Yield every value that contradicts the arm or another value."""
    margin = file.limits.joint_margin
    room = float(np.min(arm.limits.upper - arm.limits.lower)) / 2.0
    if margin > 0.0 and not margin < room:
        expected = f"less than {room:.3g} rad, half of the narrowest joint range"
        yield Implausible(("limits", "joint_margin"), f"{margin:g}", expected)
    yield from _shared_ports(file)
    yield from _simulated_ports(file)
    yield from _simulation(file.simulation, arm)


def _shared_ports(file: CellFile) -> Iterator[Implausible]:
    """Yield ports of one address that two servers would listen on; 0 is any that is free."""
    served = [
        (name, section.host, section.port)
        for name, section in (("web", file.web), ("metrics", file.metrics))
        if section is not None
    ]
    if file.setpoints.source in ("tcp", "modbus"):
        served.append(("setpoints", file.setpoints.host, file.setpoints.port))
    for (one, host, port), (other, at, same) in combinations(served, 2):
        if port == same != 0 and (host == at or {host, at} & set(ALL_ADDRESSES)):
            yield Implausible((other, "port"), f"{same}", f"another port than that of {one}.port")


def _simulated_ports(file: CellFile) -> Iterator[Implausible]:
    """Yield ports of the simulated controller that are those of another of its servers."""
    chosen = {name: getattr(file.simulation, name) for name in SIMULATED_PORTS}
    if not any(chosen.values()):
        return
    ports = dict(chosen)
    if file.link is None or isinstance(file.link, UrRtdeSettings):
        from gapbridge.drivers.simulated.ur.settings import ServerSettings  # rarely needed

        ports |= {f.name: f.default for f in fields(ServerSettings) if ports.get(f.name, 0) is None}
    for one, other in combinations(sorted(SIMULATED_PORTS, key=lambda k: chosen[k] or 0), 2):
        if ports[one] is not None and ports[one] == ports[other]:
            expected = f"another port than that of simulation.{one}"
            yield Implausible(("simulation", other), f"{ports[other]}", expected)


def _simulation(simulation: Simulation, arm: Arm) -> Iterator[Implausible]:
    """Yield what contradicts the arm in section ``simulation``."""
    top = "simulation"
    if simulation.host is not None and not is_loopback(simulation.host):
        yield Implausible(
            (top, "host"), f"{simulation.host!r}",
            "a loopback address (127.x.x.x): a simulated controller is never served to others",
        )  # fmt: skip
    of_joints = {key: getattr(simulation, key) for key in ("start_q", "droop", "zero")}
    for key in ("axial", "radial") if simulation.compliance is not None else ():
        of_joints[f"compliance.{key}"] = getattr(simulation.compliance, key)
    for key, values in of_joints.items():
        if values is not None and len(values) != arm.n:
            expected = f"{arm.n}: one for each joint of {arm.name}"
            yield Implausible((top, *key.split(".")), f"{len(values)} values", expected)
    if simulation.start_q is None or len(simulation.start_q) != arm.n:
        return
    bounds = zip(simulation.start_q, arm.limits.lower, arm.limits.upper, strict=True)
    for i, (angle, lower, upper) in enumerate(bounds):
        if abs(angle) > MAX_LIMIT:
            expected = "rad (it looks like degrees)"
        elif not lower <= angle <= upper:
            expected = f"{lower:.4g} to {upper:.4g} rad, the joint's limits"
        else:
            continue
        yield Implausible((top, "start_q", i), f"{angle:g}", expected)
