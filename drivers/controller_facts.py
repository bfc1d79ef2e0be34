"""What a controller reports about its arm, and the differences from a cell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.estimation.registration import register_robustly
from gapbridge.core.model import Model
from gapbridge.core.plausibility import flange_in_first

TCP_TURNED = 0.02  # rad: largest rotation between the controller's TCP and the cell's
OTHER_ARM, OTHER_CALIBRATION = 0.01, 5e-5  # m at the flange, after registration
MASS, COG = 0.1, 0.005  # kg, m: largest difference of the controller's payload
TILTED = 0.2  # m/s2: largest difference of gravity
POSES = 24


@dataclass(frozen=True)
class ControllerFacts:
    """What a controller reports about itself; None if it does not."""

    n: int  # joints
    model: str | None = None  # a built-in arm
    version: str | None = None
    arm: Arm | None = None  # nominal geometry with the factory calibration
    calibration: Mapping[str, Sequence[float]] = field(default_factory=dict)  # delta_*
    tcp: Array | None = None  # (4, 4) TCP in the flange frame
    payload: float | None = None  # kg
    payload_cog: Array | None = None  # (3,) m, flange frame
    gravity: Array | None = None  # (3,) m/s2 in base, towards the earth
    rate: float | None = None  # Hz, most cycles per second
    lower: Array | None = None  # (n,) rad
    upper: Array | None = None  # (n,) rad
    velocity: Array | None = None  # (n,) rad/s
    q: Array | None = None  # (n,) rad, now


@dataclass(frozen=True)
class Difference:
    """One value of the cell that differs from the controller's; ``sure``: it forbids writing."""

    keys: tuple[str, ...]  # of the cell
    found: str
    expected: str
    sure: bool = True

    def __str__(self) -> str:
        return f"{'.'.join(self.keys)}: found {self.found}, expected {self.expected}"


def differences(
    facts: ControllerFacts, model: Model, rate: float | None = None, tolerance: float = 0.005
) -> list[Difference]:
    """Return where a cell's model (and ``link.rate``, Hz) differs from its controller.

    ``tolerance``: m that the controller's TCP may be from the cell's.
    """
    if facts.n != model.arm.n:
        return [Difference(("robot",), f"{model.arm.n} joints", f"{facts.n}, as the controller")]
    result = [*_geometry(facts, model), *_tool(facts, model, tolerance), *_load(facts, model)]
    if rate is not None and facts.rate is not None and rate > 1.02 * facts.rate:
        result.append(
            Difference(("link", "rate"), f"{rate:g} Hz", f"at most {facts.rate:g} Hz", sure=False)
        )
    return result


def flange_apart(facts: ControllerFacts, arm: Arm) -> float | None:
    """Return how far (m) an arm's flange is from the controller's, in the best-fitting base frame.

    None where the controller reports no geometry, or one of other joints.
    """
    if facts.arm is None or facts.n != arm.n:
        return None
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (POSES, facts.n))
    theirs, ours = (flange_in_first(one, q)[:, :3, 3] for one in (facts.arm, arm))
    off = register_robustly(ours, theirs).in_base(ours) - theirs
    return float(np.linalg.norm(off, axis=1).max())


def _geometry(facts: ControllerFacts, model: Model) -> Iterator[Difference]:
    if (apart := flange_apart(facts, model.arm)) is not None:
        name = facts.model or "the controller's arm"
        if apart > OTHER_ARM:
            yield Difference(
                ("robot",), f"an arm whose flange is up to {1e3 * apart:.0f} mm from the "
                "controller's", f"a {name} with its factory calibration",
            )  # fmt: skip
        elif apart > OTHER_CALIBRATION:
            yield Difference(
                ("robot", "calibration"), f"geometry up to {1e3 * apart:.2f} mm from the "
                "controller's", "its factory calibration (gapbridge init writes it)", sure=False,
            )  # fmt: skip
    now, limits = facts.q, model.arm.limits
    if now is None:
        return
    beyond = (now < limits.lower - 0.05) | (now > limits.upper + 0.05)
    if beyond.any():
        joint = int(np.argmax(beyond))
        yield Difference(
            ("robot",), f"joint limits that joint {joint + 1} is beyond, at {now[joint]:.3f} rad",
            "the arm that stands there", sure=False,
        )  # fmt: skip


def _tool(facts: ControllerFacts, model: Model, tolerance: float) -> Iterator[Difference]:
    if facts.tcp is None:
        return
    model_tcp, controller_tcp = model.tool_in_flange, facts.tcp
    apart = float(np.linalg.norm(model_tcp[:3, 3] - controller_tcp[:3, 3]))
    cosine = 0.5 * (float(np.trace(model_tcp[:3, :3].T @ controller_tcp[:3, :3])) - 1.0)
    turned = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if apart > 1e-5 or turned > 1e-4:
        reported = ", ".join(f"{v:.5g}" for v in controller_tcp[:3, 3])
        # the flange of a URDF may have other axes than the controller's
        sure = (apart > tolerance or turned > TCP_TURNED) and not model.arm.joint_names
        yield Difference(
            ("tool", "tcp"), f"a TCP {1e3 * apart:.3g} mm and {turned:.2g} rad from the "
            "controller's", f"the same TCP in both (controller: xyz [{reported}])", sure=sure,
        )  # fmt: skip


def _load(facts: ControllerFacts, model: Model) -> Iterator[Difference]:
    if facts.payload is not None and abs(facts.payload - model.payload_mass) > MASS:
        yield Difference(
            ("payload", "mass"), f"{model.payload_mass:g} kg",
            f"{facts.payload:g} kg, as the controller has it", sure=False,
        )  # fmt: skip
    cog = facts.payload_cog
    if cog is not None and facts.payload and np.linalg.norm(cog - model.payload_cog) > COG:
        reported = ", ".join(f"{v:.4g}" for v in cog)
        yield Difference(
            ("payload", "cog"), f"[{', '.join(f'{v:g}' for v in model.payload_cog)}]",
            f"[{reported}], as the controller has it", sure=False,
        )  # fmt: skip
    gravity = facts.gravity
    if gravity is not None and np.linalg.norm(gravity) > 1.0:
        apart = np.abs(gravity - model.gravity)
        if np.linalg.norm(apart) > TILTED:
            reported = ", ".join(f"{v + 0.0:.4g}" for v in gravity)
            # the base of a URDF may have other horizontal axes than the controller's
            sure = not model.arm.joint_names or bool(apart[2] > TILTED)
            yield Difference(
                ("gravity",), f"[{', '.join(f'{v:g}' for v in model.gravity)}]",
                f"[{reported}], as the arm is mounted in the controller", sure=sure,
            )  # fmt: skip
