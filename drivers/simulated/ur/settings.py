"""What a simulated controller is made of: addresses, arm, plant, and how it starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from gapbridge.core.arm import Arm, builtin_names, builtin_rows
from gapbridge.core.errors import ArmError
from gapbridge.drivers.simulated.plant.declared_settings import DeclaredSettings
from gapbridge.drivers.simulated.plant.kinematics import within_limits
from gapbridge.drivers.simulated.plant.plant import Plant
from gapbridge.drivers.simulated.plant.plant_arm import PlantArm, plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import PlantSettings, draw_plant_settings
from gapbridge.drivers.simulated.ur.controller import Controller

START_Q = (0.0, -1.5, 1.8, -1.87, -1.57, 0.0)  # rad: elbow up, tool pointing down
UR_JOINTS = 6  # the fields of its protocols hold six
RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, BENCH_PORT = 30004, 29999, 30003, 30100
PRIMARY_PORT = 30001
DELTAS = ("theta", "a", "d", "alpha")

Rows = tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """One simulated controller.

    start_q: joints at power-on (6,), rad.
    declare: whether the controller is given the plant's true TCP and payload at the start.
    version: announced to clients: major, minor, bugfix.
    nominal, calibrated: DH rows (theta, a, d, alpha) that the primary interface announces; empty:
    none.
    """

    arm: PlantArm
    plant: PlantSettings
    host: str = "127.0.0.2"
    start_q: tuple[float, ...] = START_Q
    declare: bool = True
    version: tuple[int, int, int] = (5, 15, 0)
    serial: str = "20215500001"
    nominal: Rows = ()
    calibrated: Rows = ()
    rtde_port: int = RTDE_PORT
    dashboard_port: int = DASHBOARD_PORT
    script_port: int = SCRIPT_PORT
    bench_port: int = BENCH_PORT
    primary_port: int = PRIMARY_PORT


def simulated_cell(
    arm: Arm | str,
    host: str = "127.0.0.2",
    seed: int = 0,
    start_q: Sequence[float] | None = None,
    **plant: Any,
) -> ServerSettings:
    """Return a controller whose plant is drawn from `seed`.

    `plant` sets single fields of PlantSettings (tcp, payload_mass, payload_cog, gravity, ...).
    Without `start_q` (6,) (rad) the arm starts elbow up, tool down, within its joint limits.
    Raises ArmError for an arm that is unknown or has not six joints.
    """
    plant_arm(arm, UR_JOINTS)
    table, drawn, start = simulated_arm(arm, seed, start_q, **plant)
    rows = announced_rows(table.name)
    return ServerSettings(table, drawn, host, start, nominal=rows, calibrated=rows)


def announced_rows(
    model: str, calibration: Mapping[str, Sequence[float] | None] | None = None
) -> Rows:
    """Return DH rows (theta, a, d, alpha) of a built-in arm with its factory calibration, or ()."""
    if model not in builtin_names():
        return ()
    rows = []
    for i, row in enumerate(builtin_rows(model)["dh"]):
        added = [
            ((calibration or {}).get(f"delta_{key}") or [0.0] * UR_JOINTS)[i] for key in DELTAS
        ]
        values = (row.get("offset", 0.0), row["a"], row["d"], row["alpha"])
        theta, a, d, alpha = (
            float(v) + float(correction) for v, correction in zip(values, added, strict=True)
        )
        rows.append((theta, a, d, alpha))
    return tuple(rows)


def simulated_arm(
    arm: Arm | str, seed: int = 0, start_q: Sequence[float] | None = None, **plant: Any
) -> tuple[PlantArm, PlantSettings, tuple[float, ...]]:
    """Return an arm of any number of joints, its plant drawn from `seed`, and where it starts.

    `plant` sets single fields of PlantSettings. Without `start_q` (n,) (rad) the arm starts as
    START_Q says, further joints at zero, all within its limits. Raises ArmError.
    """
    table = plant_arm(arm)
    n = len(table.mass)
    joints = [*START_Q, *[0.0] * n][:n] if start_q is None else [float(q) for q in start_q]
    if len(joints) != n:
        raise ArmError(f"start_q: found {len(joints)} values, expected {n}")
    if start_q is None:
        limits = zip(joints, table.lower, table.upper, strict=True)
        joints = [min(max(q, lo), hi) for q, lo, hi in limits]
    if not within_limits(table, joints):
        raise ArmError(f"start_q: found {joints}, expected joints within the arm's limits")
    return table, replace(draw_plant_settings(table, seed), **plant), tuple(joints)


def make_controller(settings: ServerSettings) -> Controller:
    """Return the controller at rest in its start position, brakes released."""
    declared = DeclaredSettings()
    if settings.declare:
        declared.set_tcp(settings.plant.tcp)
        declared.payload_mass = settings.plant.payload_mass
        declared.payload_cog = settings.plant.payload_cog
        x, y, z = settings.plant.gravity
        declared.gravity = (-x, -y, -z)
    return Controller(Plant(settings.arm, settings.plant, settings.start_q), declared)
