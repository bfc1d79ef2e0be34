"""Plausibility of the values of a cell: wrong units are recognised by magnitude.

Impossible values are errors in every command (a TCP in mm, for instance); unusual ones are
warnings. Where a constant is a pair, it is the bound of an error and that of a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gapbridge.bridge.cell.agreement import disagreeing_values
from gapbridge.bridge.cell.message import message_at
from gapbridge.bridge.cell.schema import CellFile, Payload
from gapbridge.bridge.cell.settings.calibration import CalibrationSettings, LoadEntry
from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.files import Document
from gapbridge.core.load_bounds import LEVER, LoadBounds
from gapbridge.core.model import Model
from gapbridge.core.plausibility import (
    MAX_FIXED_ANGLE,
    MAX_LIMIT,
    MAX_SPEED,
    Implausible,
    flange_in_first,
    implausible_in_arm,
    implausible_in_urdf,
    reach,
)
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

STANDARD_GRAVITY = 9.80665  # m/s2
GRAVITY_ERROR, GRAVITY_WARNING = 1.5, 0.1  # m/s2 from the standard
SIGMA_ERROR, SIGMA_WARNING, MIN_SIGMA = 0.01, 1e-3, 1e-7  # m, 1 sigma of an instrument
MIN_TEMPERATURE, MAX_TEMPERATURE = (-60.0, -20.0), (150.0, 60.0)  # °C: error, warning
COMPLIANCE_ERROR, COMPLIANCE_WARNING = 1.0, 0.01  # rad/Nm, of one joint
CALIBRATION_ERROR, CALIBRATION_WARNING = 0.1, 0.02  # m at the flange
MAX_DISTANCE = 50.0  # m from the base: floor, boxes, instruments
MAX_SIGHT = 500.0  # m, of an instrument: laser trackers measure up to 160 m
PAYLOAD_ERROR, PAYLOAD_WARNING = 3000.0, 300.0  # kg, without a rated payload
UR_JOINTS = 6
LENGTH_ERROR_FACTOR = 2.0  # times the reach, plus 1 m


class Findings(NamedTuple):
    """Lines that name file, line, key, what was found and what was expected."""

    errors: list[str]
    warnings: list[str]


def check_plausibility(file: CellFile, document: Document, arm: Arm) -> Findings:
    """Return the impossible values of a cell (errors) and the unusual ones (warnings)."""
    errors: list[str] = []
    warnings: list[str] = []
    for value in implausible_values(file, document, arm):
        inside = f"{value.where}: " if value.where else ""
        text = f"{inside}found {value.found}, expected {value.expected}"
        line = message_at(document, value.keys, text)
        (errors if value.sure else warnings).append(line)
    return Findings(errors, warnings)


def implausible_values(file: CellFile, document: Document, arm: Arm) -> Iterator[Implausible]:
    """Yield every impossible or unusual value of a cell; those of the arm come first."""
    yield from _robot(file, document, arm)
    arm_reach = reach(arm)
    tcp = file.tool.tcp
    yield from _lengths(("tool", "tcp", "xyz"), tcp.xyz, arm_reach, "of the TCP")
    yield from _angles(("tool", "tcp", "rpy"), tcp.rpy)
    yield from _payload(("payload",), file.payload, arm, arm_reach)
    yield from _gravity_and_temperature(file)
    yield from _metrology(file)
    for key in ("axial", "radial"):
        for i, value in enumerate(getattr(file.compliance, key) or []):
            if value > COMPLIANCE_WARNING:
                yield Implausible(
                    ("compliance", key, i), f"{value:g}", "rad/Nm (a stiffness, in Nm/rad?)"
                    if value > COMPLIANCE_ERROR else "at most 0.01 rad/Nm",
                    sure=value > COMPLIANCE_ERROR,
                )  # fmt: skip
    if isinstance(file.link, UrRtdeSettings) and arm.n != UR_JOINTS:
        yield Implausible(
            ("link",), f"driver ur_rtde with an arm of {arm.n} joints", f"{UR_JOINTS}: a UR's"
        )
    if file.ft_sensor is not None:
        mounted = file.ft_sensor.sensor_in_flange
        yield from _lengths(("ft_sensor", "sensor_in_flange", "xyz"), mounted.xyz, arm_reach, "")
        yield from _angles(("ft_sensor", "sensor_in_flange", "rpy"), mounted.rpy)
    yield from _session(file.calibration, arm, arm_reach)
    if (velocity := file.limits.joint_velocity or 0.0) > MAX_SPEED:
        yield Implausible(
            ("limits", "joint_velocity"), f"{velocity:g}", "rad/s (it looks like degrees)"
        )
    if file.simulation.payload is not None:
        yield from _payload(("simulation", "payload"), file.simulation.payload, arm, arm_reach)
    yield from disagreeing_values(file, arm)


def _session(section: CalibrationSettings, arm: Arm, arm_reach: float) -> Iterator[Implausible]:
    """Yield the implausible values of section ``calibration``."""
    top = "calibration"
    rated = LoadBounds.of(Model(arm=arm)).mass
    for i, load in enumerate(section.loads):
        keys = (top, "loads", i)
        if load.mass > rated:
            yield Implausible(
                (*keys, "mass"), f"{load.mass:g} kg", f"at most {rated:.3g} kg (grams?)",
                sure=bool(np.isfinite(arm.payload)),
            )  # fmt: skip
        yield from _payload(keys, load, arm, arm_reach)
    if (sigma := section.instrument.sigma or 0.0) > SIGMA_WARNING:
        where = (top, "instrument", "sigma")
        yield Implausible(where, f"{sigma:g} m", "less than 0.001 m", sure=False)
    if section.accuracy is not None and section.accuracy >= SIGMA_ERROR:
        yield Implausible((top, "accuracy"), f"{section.accuracy:g}", "m (it looks like mm)")
    if (floor := section.floor or 0.0) < -(LENGTH_ERROR_FACTOR * arm_reach + 1.0):
        expected = "m, null for none (mm? the arm does not reach it)"
        yield Implausible((top, "floor"), f"{floor:g}", expected, sure=False)
    places: list[tuple[tuple[str | int, ...], Sequence[float]]] = [
        ((top, "floor"), [section.floor or 0.0]),
        ((top, "instrument_at"), section.instrument_at or []),
        *(((top, "further_places", i), place) for i, place in enumerate(section.further_places)),
    ]  # fmt: skip
    for i, box in enumerate(section.keep_out):
        keys = (top, "keep_out", i)
        places += [((*keys, "lower"), box.lower), ((*keys, "upper"), box.upper)]
        if np.any(np.array(box.lower) >= box.upper):
            yield Implausible((*keys, "lower"), f"{box.lower}", f"less than upper, {box.upper}")
    if (sight := section.instrument_range) is not None:
        places.append(((top, "instrument_range", "nearest"), [sight.nearest]))
        if (farthest := sight.farthest or 0.0) > MAX_SIGHT:
            where = (top, "instrument_range", "farthest")
            yield Implausible(where, f"{farthest:g}", "m (it looks like mm)")
    for at, xyz in places:
        if (size := max(map(abs, xyz), default=0.0)) > MAX_DISTANCE:
            yield Implausible(at, f"{size:g}", "m (it looks like mm)")
    for end in ("lower", "upper") if section.joint_range is not None else ():
        if (angle := max(map(abs, getattr(section.joint_range, end)), default=0.0)) > MAX_LIMIT:
            yield Implausible(
                (top, "joint_range", end), f"{angle:g}", "rad (it looks like degrees)"
            )


def _robot(file: CellFile, document: Document, arm: Arm) -> Iterator[Implausible]:
    robot = file.robot
    if robot.dh is not None and robot.model is None and robot.urdf is None:
        yield from _dh(file, arm)
        yield from implausible_in_arm(arm, ("robot", "dh"))
    if robot.urdf is not None:
        yield from implausible_in_urdf(document.path.parent / robot.urdf, arm)
        yield from implausible_in_arm(arm, ("robot", "urdf"))
    if robot.model is not None and robot.calibration is not None:
        yield from _factory_calibration(robot.model, arm)


def _dh(file: CellFile, arm: Arm) -> Iterator[Implausible]:
    """Yield lengths in mm and angles in degrees of DH rows.

    Lengths are checked only if the arm is too long: those of a factory calibration may cancel.
    """
    rows = file.robot.dh or []
    longest = max(range(len(rows)), key=lambda i: max(abs(rows[i].a), abs(rows[i].d)))
    if reach(arm) > 20.0:
        row = rows[longest]
        key = "a" if abs(row.a) > abs(row.d) else "d"
        yield Implausible(
            ("robot", "dh", longest, key), f"{getattr(row, key):g}", "m (it looks like mm)"
        )
    for i, row in enumerate(rows):
        for key in ("alpha", "offset"):
            if abs(value := getattr(row, key)) > MAX_FIXED_ANGLE:
                yield Implausible(
                    ("robot", "dh", i, key), f"{value:g}", "rad (it looks like degrees)"
                )


def _factory_calibration(model: str, arm: Arm) -> Iterator[Implausible]:
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (16, arm.n))
    nominal = builtin_arm(model)
    shift = (nominal.link_in_link[0] @ flange_in_first(nominal, q))[:, :3, 3]
    shift = shift - (arm.link_in_link[0] @ flange_in_first(arm, q))[:, :3, 3]
    largest = float(np.linalg.norm(shift, axis=1).max())
    if largest > CALIBRATION_WARNING:
        yield Implausible(
            ("robot", "calibration"), f"deltas that move the flange by {1e3 * largest:.3g} mm",
            f"a factory calibration of a {model}: a few mm", sure=largest > CALIBRATION_ERROR,
        )  # fmt: skip


def _lengths(
    keys: tuple[str | int, ...], xyz: list[float] | tuple[float, ...], arm_reach: float, what: str
) -> Iterator[Implausible]:
    size = float(np.linalg.norm(xyz))
    found = f"{size:.4g} m {what} from the flange".replace("  ", " ")
    if size > LENGTH_ERROR_FACTOR * arm_reach + 1.0:
        yield Implausible(keys, found, f"m (it looks like mm: the arm reaches {arm_reach:.2f} m)")
    elif size > arm_reach:
        yield Implausible(keys, found, f"less than the arm's reach, {arm_reach:.2f} m", sure=False)


def _angles(
    keys: tuple[str | int, ...], rpy: list[float] | tuple[float, ...]
) -> Iterator[Implausible]:
    worst = max(abs(v) for v in rpy)
    if worst > MAX_FIXED_ANGLE:
        yield Implausible(keys, f"{worst:g}", "rad (it looks like degrees)")
    elif worst > 3.2:
        yield Implausible(keys, f"{worst:g}", "rad, at most half a turn", sure=False)


def _payload(
    keys: tuple[str | int, ...], payload: Payload | LoadEntry, arm: Arm, arm_reach: float
) -> Iterator[Implausible]:
    yield from _lengths((*keys, "cog"), payload.cog, arm_reach, "of the centre of gravity")
    if np.isfinite(arm.payload):
        bounds = LoadBounds.of(Model(arm=arm))
        moment = payload.mass * float(np.linalg.norm(payload.cog))
        if moment > LEVER * bounds.mass:
            yield Implausible(
                (*keys, "cog"), f"{payload.mass:g} kg at {np.linalg.norm(payload.cog):.3g} m",
                f"at most {LEVER * bounds.mass:.3g} kg m ({arm.name})", sure=False,
            )  # fmt: skip
        return
    links = float(arm.mass.sum())
    for limit, sure in ((PAYLOAD_ERROR, True), (links or PAYLOAD_WARNING, False)):
        if payload.mass > limit:
            expected = "kg (grams?)" if sure else f"at most {limit:.3g} kg"
            yield Implausible((*keys, "mass"), f"{payload.mass:g} kg", expected, sure=sure)
            return


def _gravity_and_temperature(file: CellFile) -> Iterator[Implausible]:
    size = float(np.linalg.norm(file.gravity))
    if size == 0.0:
        yield Implausible(("gravity",), "0", "9.80665 m/s2: without it no weight bends", sure=False)
    elif abs(size - STANDARD_GRAVITY) > GRAVITY_ERROR:
        yield Implausible(("gravity",), f"a length of {size:g}", "9.80665 m/s2, along base axes")
    elif abs(size - STANDARD_GRAVITY) > GRAVITY_WARNING:
        yield Implausible(("gravity",), f"a length of {size:g}", "9.7 to 9.9 m/s2", sure=False)
    value = file.reference_temperature
    if not MIN_TEMPERATURE[0] <= value <= MAX_TEMPERATURE[0]:
        yield Implausible(("reference_temperature",), f"{value:g}", "°C (it looks like kelvin)")
    elif not MIN_TEMPERATURE[1] <= value <= MAX_TEMPERATURE[1]:
        yield Implausible(("reference_temperature",), f"{value:g}", "°C (Fahrenheit?)", sure=False)


def _metrology(file: CellFile) -> Iterator[Implausible]:
    entry = file.metrology
    for key, value in (("sigma", entry.sigma), ("repeatability", entry.repeatability)):
        if value is None:
            continue
        keys = ("metrology", key)
        if value >= SIGMA_ERROR:
            yield Implausible(keys, f"{value:g}", "m, 1 sigma of one coordinate (it looks like mm)")
        elif value > SIGMA_WARNING:
            yield Implausible(keys, f"{value:g} m", "less than 0.001 m", sure=False)
        elif 0.0 < value < MIN_SIGMA:
            yield Implausible(keys, f"{value:g} m", "more than 1e-7 m", sure=False)
