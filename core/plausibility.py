"""Plausibility of an arm: reach, masses, limits, and the values of its URDF.

A length in millimetres or an angle in degrees is a hundred or a thousand times too large for any
arm: such values are errors. Values that few arms have are warnings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.files import read_text

URDF = ("robot", "urdf")  # key of the cell that names the file
POSES = 64
MAX_REACH, LARGE_REACH, SMALL_REACH = 20.0, 5.0, 0.05  # m of reach: no arm, few arms, few arms
MAX_FIXED_ANGLE = 6.4  # rad: a little more than one turn; a fixed angle beyond is in degrees
MAX_LIMIT = 25.0  # rad: no revolute joint is limited further out
MAX_SPEED = 60.0  # rad/s: no joint of an arm turns quicker
LARGE_MASS, MAX_MASS = 500.0, 5000.0  # kg of one link: few arms, no arm
MAX_DENSITY = 2000.0  # kg of the arm by the cube of its reach, m: arms have 10 to 250


@dataclass(frozen=True)
class Implausible:
    """One implausible value: an error (``sure``) or a warning.

    ``keys`` is its path in the cell; ``where`` its place in another file.
    """

    keys: tuple[str | int, ...]
    found: str
    expected: str
    sure: bool = True
    where: str = ""


@np.errstate(all="ignore")  # what overflows is refused as implausible, without numpy's warnings
def reach(arm: Arm, seed: int = 0) -> float:
    """Return the largest distance (m) of the flange from joint 1, over random poses.

    Not the sum of lengths: a factory calibration may have lengths of hundreds of metres, which
    cancel.
    """
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (POSES, arm.n))
    return float(np.linalg.norm(flange_in_first(arm, q)[:, :3, 3], axis=1).max())


def flange_in_first(arm: Arm, q: Array) -> Array:
    """Return the rigid flange (N, 4, 4) in joint 1's frame at zero, for q (N, n) in rad."""
    frame = np.tile(np.eye(4), (len(q), 1, 1))
    for i in range(arm.n):
        c, s = np.cos(q[:, i]), np.sin(q[:, i])
        rotation = np.tile(np.eye(4), (len(q), 1, 1))
        rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1] = c, -s, s, c
        frame = frame @ rotation @ arm.link_in_link[i + 1]
    return np.asarray(frame)


def implausible_in_arm(arm: Arm, keys: tuple[str | int, ...]) -> Iterator[Implausible]:
    """Yield the implausible values of an arm; ``keys`` is its path in the cell."""
    reach_m = reach(arm)
    if reach_m > MAX_REACH:
        yield Implausible(
            keys, f"an arm of {reach_m:.4g} m reach", "lengths in m (these look like mm)"
        )
    elif not SMALL_REACH <= reach_m <= LARGE_REACH:
        yield Implausible(keys, f"an arm of {reach_m:.3g} m reach", "0.05 to 5 m", sure=False)
    for i, mass in enumerate(arm.mass):
        if mass < 0 or mass > MAX_MASS:
            yield Implausible(keys, f"{mass:.4g} kg of link {i + 1}", "kg, 0 or more (grams?)")
        elif mass > LARGE_MASS:
            yield Implausible(keys, f"{mass:.4g} kg of link {i + 1}", "at most 500 kg", sure=False)
        distance = math.hypot(*arm.cog[i]) if mass > 0 else 0.0
        if reach_m <= MAX_REACH and distance > 2.0 * reach_m + 1.0:
            yield Implausible(
                keys, f"a centre of gravity of link {i + 1} {distance:.4g} m off", "m (mm?)"
            )
        inertia = float(np.abs(arm.inertia[i]).max())
        if inertia > MAX_MASS * MAX_REACH**2 or inertia > mass * (2.0 * reach_m + 1.0) ** 2 > 0:
            yield Implausible(
                keys, f"{inertia:.4g} kg m2, inertia of link {i + 1}", "kg m2 (g mm2?): less than "
                "its mass has at that reach", sure=inertia > MAX_MASS * MAX_REACH**2,
            )  # fmt: skip
    if (mass := float(arm.mass.sum())) > MAX_DENSITY * reach_m**3 and mass > LARGE_MASS:
        yield Implausible(keys, f"an arm of {mass:.4g} kg and {reach_m:.3g} m reach", "kg (grams?)")
    massless = [str(i + 1) for i in range(arm.n) if arm.mass[i] == 0]
    if len(massless) == arm.n:
        yield Implausible(
            keys, "an arm without masses", "the links' masses: without them only payload and "
            "pulls bend the model", sure=False,
        )  # fmt: skip
    elif massless:
        yield Implausible(keys, f"no mass of link {', '.join(massless)}", "one", sure=False)


def implausible_in_urdf(path: Path, arm: Arm) -> Iterator[Implausible]:
    """Yield implausible values in a URDF, of which ``arm`` was made."""
    text = read_text(path)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return
    for joint in root.findall("joint"):
        name = str(joint.get("name"))
        # with a type: transmissions and controllers name joints too
        tag = rf"<joint\b(?=[^>]*\btype\s*=)[^>]*\bname\s*=\s*[\"']{re.escape(name)}[\"']"
        found = re.search(tag, text)
        line = 1 + text.count("\n", 0, found.start()) if found else 1
        where = f"{path}, line {line}: joint {name!r}"
        if name in arm.joint_names and joint.find("mimic") is not None:
            yield Implausible(
                URDF, "<mimic>", "a motor of its own for every joint between base and flange: "
                "this one follows another", where=where,
            )  # fmt: skip
        origin, limit = joint.find("origin"), joint.find("limit")
        if (reach_m := _largest(origin, "xyz")) > MAX_REACH:
            yield Implausible(URDF, f"origin xyz {reach_m:g}", "m (it looks like mm)", where=where)
        if (angle := _largest(origin, "rpy")) > MAX_FIXED_ANGLE:
            yield Implausible(
                URDF, f"origin rpy {angle:g}", "rad (it looks like degrees)", where=where
            )
        if joint.get("type") != "revolute":
            continue
        for key, most, expected in (
            ("lower", MAX_LIMIT, "rad (it looks like degrees)"),
            ("upper", MAX_LIMIT, "rad (it looks like degrees)"),
            ("velocity", MAX_SPEED, "the joint's largest speed in rad/s, or none if unknown"),
        ):
            if (value := _largest(limit, key)) > most:
                yield Implausible(URDF, f"limit {key} {value:g}", expected, where=where)
        i = arm.joint_names.index(name) if name in arm.joint_names else None
        if i is not None and (lower := arm.limits.lower[i]) > (upper := arm.limits.upper[i]):
            both = f"limit lower {lower:g} and upper {upper:g}"
            yield Implausible(URDF, both, "lower below upper", where=where)


def _largest(element: ElementTree.Element | None, key: str) -> float:
    """Return the largest magnitude in an attribute; 0 where it is not there or no number."""
    try:
        return max(
            (abs(float(v)) for v in str((element.get(key) if element is not None else None) or "")
             .split()), default=0.0,
        )  # fmt: skip
    except ValueError:
        return 0.0
