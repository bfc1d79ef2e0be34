"""Effects hidden in the demo's simulated arm that the fit of the flexibilities does not model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

MAX_DROOP = 5.0e-3  # rad, largest deflection of a servo under the holding torque
TOOL_SHIFTS = (1.0e-3, 2.5e-3)  # m, range of the shift of a bent tool
JOINT_ZEROS, ZERO_JOINTS = (2.5e-3, 4.0e-3), (2, 4, 5)  # rad, offset; positive lowers the arm
ALWAYS_TRUE = ("axial_compliance", "radial_compliance")  # the arm bends; a fit is not exact
MAX_SIGMAS = 4.0  # largest accepted error of an estimate, in its standard deviations
TOLERANCE = 2e-5  # SI: bias of an estimate whose flexibilities were fitted without the effect


@dataclass(frozen=True)
class NamedCause:
    """A cause named by the diagnosis; parameters as name, value, standard deviation, unit."""

    effect: str
    parameters: tuple[tuple[str, float, float, str], ...]


@dataclass(frozen=True)
class HiddenEffects:
    """Effects of the simulated arm that the demo's cell does not model.

    effects: identifiers in the catalogue. description: what happened, for reports.
    truth: true values (SI) by parameter name.
    simulation: the same as keys of a cell's section ``simulation`` (fields of PlantSettings).
    """

    effects: tuple[str, ...]
    description: str
    truth: Mapping[str, float]
    simulation: Mapping[str, tuple[float, ...]]

    @classmethod
    def drawn(cls, seed: int, choices: tuple[str, ...]) -> HiddenEffects:
        """Return one of ``choices`` (keys of DRAW_FUNCTIONS); seed draws choice and size."""
        index = np.random.default_rng((seed, 37)).integers(len(choices))
        return DRAW_FUNCTIONS[choices[int(index)]](np.random.default_rng((seed, 29)))

    def combined(self, other: HiddenEffects) -> HiddenEffects:
        """Return the effects of both."""
        return HiddenEffects(
            self.effects + other.effects, f"{self.description}, and {other.description}",
            {**self.truth, **other.truth}, {**self.simulation, **other.simulation},
        )  # fmt: skip

    def mismatches(self, causes: Iterable[NamedCause]) -> list[str]:
        """Return a line for each false cause, each missed effect and each wrong value.

        A value is right within MAX_SIGMAS of its standard deviations plus TOLERANCE.
        """
        causes = list(causes)
        lines = [
            f"{cause.effect} is named as a cause, but this arm does not have it"
            for cause in causes
            if cause.effect not in (*self.effects, *ALWAYS_TRUE)
        ]
        named = {cause.effect for cause in causes}
        lines += [f"{e} is in the arm but was not named" for e in self.effects if e not in named]
        estimates = [p for c in causes if c.effect in self.effects for p in c.parameters]
        for name, value, std, _ in estimates:
            true = self.truth.get(name, 0.0)
            if abs(value - true) > MAX_SIGMAS * std + TOLERANCE:
                lines.append(f"{name} was estimated as {value:.6f} ± {std:.6f}, true {true:.6f}")
        return lines


def _bent_tool(rng: np.random.Generator) -> HiddenEffects:
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    shift = tuple(float(v) for v in direction * rng.uniform(*TOOL_SHIFTS))
    truth = {f"tool_frame_{axis}": v for axis, v in zip("xyz", shift, strict=True)}
    return HiddenEffects(("tool_frame",), "the tool is also bent", truth, {"tool_shift": shift})


def _shifted_zero(rng: np.random.Generator) -> HiddenEffects:
    joint, value = int(rng.choice(ZERO_JOINTS)), float(rng.uniform(*JOINT_ZEROS))
    zero = tuple(value if i + 1 == joint else 0.0 for i in range(6))
    truth = {f"joint_offset_{joint}": value}
    return HiddenEffects(("joint_offset",), "a joint's zero is also off", truth, {"zero": zero})


def yielding_servos(seed: int, torque: Sequence[float]) -> HiddenEffects:
    """Return servos that yield by 3.5 to 5 mrad under holding torques ``torque`` (n,), Nm.

    A servo that holds 1 Nm or less does not yield.
    """
    rng = np.random.default_rng((seed, 31))
    share = rng.uniform(0.7, 1.0, len(torque))
    droop = tuple(
        float(MAX_DROOP * s / t) if t > 1.0 else 0.0 for s, t in zip(share, torque, strict=True)
    )
    truth = {f"servo_droop_{i + 1}": v for i, v in enumerate(droop) if v}
    return HiddenEffects(("servo_droop",), "its servos yield under load", truth, {"droop": droop})


DRAW_FUNCTIONS: dict[str, Callable[[np.random.Generator], HiddenEffects]] = {
    "bent_tool": _bent_tool, "shifted_zero": _shifted_zero,
}  # fmt: skip
"""Effects that may be hidden; the diagnosis identifies each of them at any seed."""


def named_causes(document: Mapping[str, Any]) -> tuple[NamedCause, ...]:
    """Return the causes that a diagnosis names, from its JSON."""
    return tuple(
        NamedCause(
            cause["effect"],
            tuple((p["name"], p["value"], p["std"], p["unit"]) for p in cause["parameters"]),
        )
        for channel in document["channels"]
        for cause in channel["causes"]
    )  # fmt: skip
