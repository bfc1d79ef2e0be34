"""Whether the values of a cell can be meant: units by their size, before anything is computed.

A TCP in millimetres puts the tool a hundred metres off and every later number with it. What is
surely wrong is an error in every command; what is only odd is a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gapbridge.bridge.cell.message import key_path
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

STANDARD = 9.80665  # m/s2
SENSIBLE_GRAVITY, EARTH = 1.5, 0.1  # m/s2 beside the standard: no place, no place on the ground
COARSEST, COARSE, FINE = 0.01, 1e-3, 1e-7  # m: 1 sigma of no instrument, of few instruments
COLD, HOT = (-60.0, -20.0), (150.0, 60.0)  # °C: never, hardly
SOFTEST, SOFT = 1.0, 0.01  # rad/Nm: no joint, few joints
CALIBRATED, MUCH = 0.1, 0.02  # m at the flange: no factory calibration, few
FARTHEST = 50.0  # m: no floor, box or instrument is so far from a base
HEAVIEST_LOAD, HEAVY_LOAD = 3000.0, 300.0  # kg, where the arm's rating is not known
UR_JOINTS = 6
DISPLACED = 2.0  # times the reach, and a metre: no tool is that long


class Findings(NamedTuple):
    """Lines that name file, line, key, what was found and what was expected."""

    errors: list[str]
    warnings: list[str]


def findings(file: CellFile, document: Document, arm: Arm) -> Findings:
    """Return what cannot be meant in a cell's values (errors), and what is odd (warnings)."""
    errors: list[str] = []
    warnings: list[str] = []
    for value in implausible_values(file, document, arm):
        place = f"{document.path}, line {document.line(value.keys)}: {key_path(value.keys)}"
        inside = f": {value.where}" if value.where else ""
        line = f"{place}{inside}: found {value.found}, expected {value.expected}"
        (errors if value.sure else warnings).append(line)
    return Findings(errors, warnings)


def implausible_values(file: CellFile, document: Document, arm: Arm) -> Iterator[Implausible]:
    """Yield every value of a cell that cannot be meant, or hardly; the arm's own come first."""
    yield from _robot(file, document, arm)
    far = reach(arm)
    tcp = file.tool.tcp
    yield from _length(("tool", "tcp", "xyz"), tcp.xyz, far, "of the TCP")
    yield from _angles(("tool", "tcp", "rpy"), tcp.rpy)
    yield from _payload(("payload",), file.payload, arm, far)
    yield from _surroundings(file)
    yield from _metrology(file)
    for key in ("axial", "radial"):
        for i, value in enumerate(getattr(file.compliance, key) or []):
            if value > SOFT:
                yield Implausible(
                    ("compliance", key, i), f"{value:g}", "rad/Nm (a stiffness, in Nm/rad?)"
                    if value > SOFTEST else "at most 0.01 rad/Nm", sure=value > SOFTEST,
                )  # fmt: skip
    if isinstance(file.link, UrRtdeSettings) and arm.n != UR_JOINTS:
        yield Implausible(
            ("link",), f"driver ur_rtde with an arm of {arm.n} joints", f"{UR_JOINTS}: a UR's"
        )
    if file.ft_sensor is not None:
        mounted = file.ft_sensor.sensor_in_flange
        yield from _length(("ft_sensor", "sensor_in_flange", "xyz"), mounted.xyz, far, "")
        yield from _angles(("ft_sensor", "sensor_in_flange", "rpy"), mounted.rpy)
    yield from _session(file.calibration, arm, far)
    if (quick := file.limits.joint_velocity or 0.0) > MAX_SPEED:
        yield Implausible(
            ("limits", "joint_velocity"), f"{quick:g}", "rad/s (it looks like degrees)"
        )
    if file.simulation.payload is not None:
        yield from _payload(("simulation", "payload"), file.simulation.payload, arm, far)
    for i, angle in enumerate(file.simulation.start_q or []):
        if abs(angle) > MAX_LIMIT:
            yield Implausible(
                ("simulation", "start_q", i), f"{angle:g}", "rad (it looks like degrees)"
            )


def _session(given: CalibrationSettings, arm: Arm, far: float) -> Iterator[Implausible]:
    """Yield what cannot be meant in the section of calibration sessions."""
    top = "calibration"
    rated = LoadBounds.of(Model(arm=arm)).mass
    for i, load in enumerate(given.loads):
        keys = (top, "loads", i)
        if load.mass > rated:
            yield Implausible(
                (*keys, "mass"), f"{load.mass:g} kg", f"at most {rated:.3g} kg (grams?)",
                sure=bool(np.isfinite(arm.payload)),
            )  # fmt: skip
        yield from _payload(keys, load, arm, far)
    if given.accuracy is not None and given.accuracy >= COARSEST:
        yield Implausible((top, "accuracy"), f"{given.accuracy:g}", "m (it looks like mm)")
    places: list[tuple[tuple[str | int, ...], Sequence[float]]] = [
        ((top, "floor"), [given.floor or 0.0]), ((top, "instrument_at"), given.instrument_at or []),
        *(((top, "further_places", i), place) for i, place in enumerate(given.further_places)),
    ]  # fmt: skip
    for i, box in enumerate(given.keep_out):
        keys = (top, "keep_out", i)
        places += [((*keys, "lower"), box.lower), ((*keys, "upper"), box.upper)]
        if np.any(np.array(box.lower) > box.upper):
            yield Implausible((*keys, "lower"), f"{box.lower}", f"no more than upper, {box.upper}")
    for where, xyz in places:
        if (size := max(map(abs, xyz), default=0.0)) > FARTHEST:
            yield Implausible(where, f"{size:g}", "m (it looks like mm)")
    for end in ("lower", "upper") if given.joint_range is not None else ():
        if (angle := max(map(abs, getattr(given.joint_range, end)))) > MAX_LIMIT:
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
        yield from _calibration(robot.model, arm)


def _dh(file: CellFile, arm: Arm) -> Iterator[Implausible]:
    """Yield lengths in mm and angles in degrees of DH rows.

    Lengths count only where the arm comes out too long: of a calibration they may cancel.
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


def _calibration(model: str, arm: Arm) -> Iterator[Implausible]:
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (16, arm.n))
    nominal = builtin_arm(model)
    apart = (nominal.link_in_link[0] @ flange_in_first(nominal, q))[:, :3, 3]
    apart = apart - (arm.link_in_link[0] @ flange_in_first(arm, q))[:, :3, 3]
    shift = float(np.linalg.norm(apart, axis=1).max())
    if shift > MUCH:
        yield Implausible(
            ("robot", "calibration"), f"deltas that move the flange by {1e3 * shift:.3g} mm",
            f"a factory calibration of a {model}: a few mm", sure=shift > CALIBRATED,
        )  # fmt: skip


def _length(
    keys: tuple[str | int, ...], xyz: list[float] | tuple[float, ...], far: float, what: str
) -> Iterator[Implausible]:
    size = float(np.linalg.norm(xyz))
    found = f"{size:.4g} m {what} from the flange".replace("  ", " ")
    if size > DISPLACED * far + 1.0:
        yield Implausible(keys, found, f"m (it looks like mm: the arm reaches {far:.2f} m)")
    elif size > far:
        yield Implausible(keys, found, f"less than the arm's reach, {far:.2f} m", sure=False)


def _angles(
    keys: tuple[str | int, ...], rpy: list[float] | tuple[float, ...]
) -> Iterator[Implausible]:
    worst = max(abs(v) for v in rpy)
    if worst > MAX_FIXED_ANGLE:
        yield Implausible(keys, f"{worst:g}", "rad (it looks like degrees)")
    elif worst > 3.2:
        yield Implausible(keys, f"{worst:g}", "rad, at most half a turn", sure=False)


def _payload(
    keys: tuple[str | int, ...], payload: Payload | LoadEntry, arm: Arm, far: float
) -> Iterator[Implausible]:
    yield from _length((*keys, "cog"), payload.cog, far, "of the centre of gravity")
    if np.isfinite(arm.payload):
        bounds = LoadBounds.of(Model(arm=arm))
        moment = payload.mass * float(np.linalg.norm(payload.cog))
        if moment > LEVER * bounds.mass:
            yield Implausible(
                (*keys, "cog"), f"{payload.mass:g} kg at {np.linalg.norm(payload.cog):.3g} m",
                f"at most {LEVER * bounds.mass:.3g} kg m ({arm.name})", sure=False,
            )  # fmt: skip
        return
    own = float(arm.mass.sum())
    for most, sure in ((HEAVIEST_LOAD, True), (own or HEAVY_LOAD, False)):
        if payload.mass > most:
            expected = "kg (grams?)" if sure else f"at most {most:.3g} kg"
            yield Implausible((*keys, "mass"), f"{payload.mass:g} kg", expected, sure=sure)
            return


def _surroundings(file: CellFile) -> Iterator[Implausible]:
    size = float(np.linalg.norm(file.gravity))
    if size == 0.0:
        yield Implausible(("gravity",), "0", "9.80665 m/s2: without it no weight bends", sure=False)
    elif abs(size - STANDARD) > SENSIBLE_GRAVITY:
        yield Implausible(("gravity",), f"a length of {size:g}", "9.80665 m/s2, along base axes")
    elif abs(size - STANDARD) > EARTH:
        yield Implausible(("gravity",), f"a length of {size:g}", "9.7 to 9.9 m/s2", sure=False)
    value = file.reference_temperature
    if not COLD[0] <= value <= HOT[0]:
        yield Implausible(("reference_temperature",), f"{value:g}", "°C (it looks like kelvin)")
    elif not COLD[1] <= value <= HOT[1]:
        yield Implausible(("reference_temperature",), f"{value:g}", "°C (Fahrenheit?)", sure=False)


def _metrology(file: CellFile) -> Iterator[Implausible]:
    entry = file.metrology
    for key, value in (("sigma", entry.sigma), ("repeatability", entry.repeatability)):
        if value is None:
            continue
        keys = ("metrology", key)
        if value >= COARSEST:
            yield Implausible(keys, f"{value:g}", "m, 1 sigma of one coordinate (it looks like mm)")
        elif value > COARSE:
            yield Implausible(keys, f"{value:g} m", "less than 0.001 m", sure=False)
        elif 0.0 < value < FINE:
            yield Implausible(keys, f"{value:g} m", "more than 1e-7 m", sure=False)
