"""The nominal arm: kinematics, masses and joint limits."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import numpy as np
import yaml

from gapbridge.core.arrays import Array
from gapbridge.core.errors import ArmError, Keys
from gapbridge.core.files import loaders

DH_KEYS = ("robot", "dh")  # of the cell file
_FASTEST = loaders()[0]  # of YAML


@dataclass(frozen=True)
class JointLimits:
    """Limits per joint, all (n,); infinite where unlimited or unknown."""

    lower: Array  # rad
    upper: Array  # rad
    velocity: Array  # rad/s
    effort: Array  # Nm

    @classmethod
    def none(cls, n: int) -> JointLimits:
        """Return infinite limits."""
        infinite = np.full(n, np.inf)
        return cls(-infinite, infinite, infinite.copy(), infinite.copy())


@dataclass(frozen=True)
class Arm:
    """A serial arm of n revolute joints, each turning about the z axis of its own joint frame.

    ``link_in_link[0]`` places joint 1 in base; ``link_in_link[i]`` places joint i+1 (``[n]``: the
    flange) in the frame of link i, which is joint i's frame after its rotation. For standard DH
    rows, the frame of joint i is DH frame i-1 and ``link_in_link[i]`` is Tz(d_i) Tx(a_i)
    Rx(alpha_i).
    """

    name: str
    link_in_link: Array  # (n+1, 4, 4) m
    mass: Array  # (n,) kg
    cog: Array  # (n, 3) m, of link i in the frame of link i
    inertia: Array  # (n, 3, 3) kg m2, about the centre of gravity, axes of link i
    limits: JointLimits
    payload: float = np.inf  # kg, rated
    joint_names: tuple[str, ...] = field(default=())
    # (n, 3, 3): axes of the URDF link, or of the DH row, in the frame of link i; None: the same
    body_axes: Array | None = None

    @property
    def n(self) -> int:
        """Return the number of joints."""
        return len(self.mass)

    @property
    def length(self) -> float:
        """Return the length of the stretched arm (m), base to flange."""
        return float(np.linalg.norm(self.link_in_link[:, :3, 3], axis=1).sum())


def dh_transform(a: float, alpha: float, d: float) -> Array:
    """Return Tz(d) Tx(a) Rx(alpha) (4, 4): a standard DH row behind the joint's own rotation."""
    ca, sa = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, ca, -sa, 0], [0, sa, ca, d], [0, 0, 0, 1]], dtype=float)


def arm_from_dh(
    rows: Sequence[Mapping[str, Any]], name: str = "dh", limits: JointLimits | None = None
) -> Arm:
    """Return the arm of standard DH rows ``{a, alpha, d, offset, mass, cog}``, as a cell has them.

    ``cog`` is in the row's own frame (DH frame i). Mass and cog may be left out (zero). Raises
    ArmError where a row lacks a, alpha or d, or holds something that is not a finite number.
    """
    if not rows:
        raise ArmError("found no rows, expected one row {a, alpha, d} per joint", DH_KEYS)
    n = len(rows)
    links = np.tile(np.eye(4), (n + 1, 1, 1))
    mass, cog, axes = np.zeros(n), np.zeros((n, 3)), np.empty((n, 3, 3))
    rotation = np.eye(4)
    for i, row in enumerate(rows):
        keys = (*DH_KEYS, i)
        a, alpha, d = (_read_number(row, key, keys) for key in ("a", "alpha", "d"))
        offset = _read_number(row, "offset", keys, 0.0)
        c, s = np.cos(offset), np.sin(offset)
        rotation[:2, :2] = [[c, -s], [s, c]]
        links[i] = links[i] @ rotation
        links[i + 1] = dh_transform(a, alpha, d)
        mass[i] = _read_number(row, "mass", keys, 0.0)
        if mass[i] < 0:
            raise ArmError(f"found {mass[i]:g}, expected 0 or more kg", (*keys, "mass"))
        in_row, axes[i] = _read_cog(row, keys), links[i + 1][:3, :3]
        cog[i] = axes[i] @ in_row + links[i + 1][:3, 3]
    inertia, limits = np.zeros((n, 3, 3)), limits or JointLimits.none(n)
    return Arm(name, links, mass, cog, inertia, limits, body_axes=axes)


def _read_cog(row: Mapping[str, Any], keys: Keys) -> Array:
    value = row.get("cog")
    try:
        centre = np.zeros(3) if value is None else np.array(value, dtype=float)
    except (TypeError, ValueError):
        centre = np.full(3, np.nan)
    if centre.shape != (3,) or not np.isfinite(centre).all():
        raise ArmError(f"found {value}, expected three numbers (m)", (*keys, "cog"))
    return centre


def _read_number(
    row: Mapping[str, Any], key: str, keys: Keys, default: float | None = None
) -> float:
    value = row.get(key, default)
    if value is None:
        raise ArmError("found nothing, expected a number", (*keys, key))
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ArmError(f"found {value!r}, expected a number", (*keys, key)) from None
    if not np.isfinite(number):
        raise ArmError(f"found {value!r}, expected a finite number", (*keys, key))
    return number


def builtin_names() -> tuple[str, ...]:
    """Return the names of the built-in arms."""
    files = resources.files("gapbridge.core").joinpath("arms").iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def builtin_rows(name: str) -> dict[str, Any]:
    """Return the content of a built-in table (``core/arms/NAME.yaml``).

    Raises ArmError naming the nearest known arm where there is no such table.
    """
    names = builtin_names()
    if name not in names:
        near = difflib.get_close_matches(str(name), names, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        text = f"found {name!r}, expected one of {', '.join(names)}{hint}"
        raise ArmError(text, ("robot", "model"))
    text = (
        resources.files("gapbridge.core")
        .joinpath("arms", f"{name}.yaml")
        .read_text(encoding="utf-8")
    )
    table: dict[str, Any] = yaml.load(text, _FASTEST)
    return table


def builtin_arm(name: str, calibration: Mapping[str, Sequence[float]] | None = None) -> Arm:
    """Return a built-in arm, with its factory calibration where one is given.

    ``calibration`` holds UR's ``delta_theta``, ``delta_a``, ``delta_d``, ``delta_alpha`` (n each),
    the entries of the controller's calibration.conf, which are added to the DH rows. Joint origins
    stay at their nominal places on the axes (``_on_nominal_axes``).
    """
    table = builtin_rows(name)
    rows = table["dh"]
    nominal = arm_from_dh(rows, name)
    for delta, key in (("theta", "offset"), ("a", "a"), ("d", "d"), ("alpha", "alpha")):
        values = (calibration or {}).get(f"delta_{delta}")
        if values is None:
            continue
        if len(values) != len(rows):
            raise ArmError(
                f"found {len(values)} values, expected {len(rows)}",
                ("robot", "calibration", f"delta_{delta}"),
            )
        for row, value in zip(rows, values, strict=True):
            row[key] = row.get(key, 0.0) + float(value)
    limits = table["limits"]
    columns = {key: np.array([float(row[key]) for row in limits]) for key in limits[0]}
    arm = arm_from_dh(rows, name, JointLimits(**columns))
    if calibration:
        arm = _on_nominal_axes(arm, nominal)
    return replace(arm, payload=float(table["payload"]))


def _on_nominal_axes(arm: Arm, nominal: Arm) -> Arm:
    """Return ``arm`` with each joint frame slid along its own axis to where ``nominal`` has it.

    The common normals of nearly parallel axes are far away: factory calibrations have d of hundreds
    of metres that cancel from joint 2 to 3, and angles that cancel likewise. Rotation about an axis
    and translation along it commute, so that every rigid pose is unchanged; but joints bend at
    their origins. The links' masses keep their place in base with all joints at zero. Frames keep
    their direction.
    """
    frames, nominal_frames = _joint_frames_at_zero(arm), _joint_frames_at_zero(nominal)
    links, cog = arm.link_in_link.copy(), arm.cog.copy()
    for i in range(arm.n):
        slide = np.eye(4)
        slide[2, 3] = (nominal_frames[i, :3, 3] - frames[i, :3, 3]) @ frames[i, :3, 2]
        links[i] = links[i] @ slide
        slide[2, 3] *= -1
        links[i + 1] = slide @ links[i + 1]
        at_zero = nominal_frames[i, :3, :3] @ nominal.cog[i] + nominal_frames[i, :3, 3]
        cog[i] = (at_zero - frames[i, :3, 3]) @ frames[i, :3, :3] + slide[:3, 3]
    return replace(arm, link_in_link=links, cog=cog)


def _joint_frames_at_zero(arm: Arm) -> Array:
    """Return the frames of the joints in base (n, 4, 4), all joints at zero."""
    frames = [arm.link_in_link[0]]
    for i in range(1, arm.n):
        frames.append(frames[-1] @ arm.link_in_link[i])
    return np.array(frames)
