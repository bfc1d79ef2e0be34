"""What is hidden in the demo's arm beside its flexibilities: effects that no fit knows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

GIVES = 5.0e-3  # rad: what servos that give way come to at most
SHIFTS = (1.0e-3, 2.5e-3)  # m, of a tool that hit something
ZEROS, ZERO_JOINTS = (2.5e-3, 4.0e-3), (2, 4, 5)  # rad, of a joint whose encoder was replaced
TRUE_ANYWAY = ("axial_compliance", "radial_compliance")  # the arm bends, and a fit is not exact
SIGMAS = 4.0  # of its own, within which a found value holds the truth
FLOOR = 2e-5  # SI: what flexibilities fitted beside the effect, not with it, leave in its value


@dataclass(frozen=True)
class Accused:
    """A cause that the diagnosis named, with its numbers: name, value, 1 sigma, unit."""

    effect: str
    joints: tuple[int, ...]
    parameters: tuple[tuple[str, float, float, str], ...]


@dataclass(frozen=True)
class Hidden:
    """Effects of the arm that the demo's cell does not know.

    effects: as the diagnosis names them; about: what happened, for people.
    truth: its true numbers by the names of the diagnosis, SI.
    simulation: the same as keys of a cell's section ``simulation``, fields of PlantSettings.
    """

    effects: tuple[str, ...]
    about: str
    truth: Mapping[str, float]
    simulation: Mapping[str, tuple[float, ...]]

    @classmethod
    def drawn(cls, seed: int, among: tuple[str, ...]) -> Hidden:
        """Return one of the effects ``among``, which and how large drawn from the seed."""
        which = np.random.default_rng((seed, 37)).integers(len(among))
        return DRAWS[among[int(which)]](np.random.default_rng((seed, 29)))

    def beside(self, other: Hidden) -> Hidden:
        """Return what is hidden where both are."""
        return Hidden(
            self.effects + other.effects, f"{self.about}, and {other.about}",
            {**self.truth, **other.truth}, {**self.simulation, **other.simulation},
        )  # fmt: skip

    def denials(self, accused: Iterable[Accused]) -> list[str]:
        """Return a line for each accusation that the truth does not hold, and for what is missing.

        A number is held by the truth within SIGMAS of its own standard deviation and FLOOR.
        """
        accused = list(accused)
        lines = [
            f"{cause.effect} is accused, and this arm has none"
            for cause in accused
            if cause.effect not in (*self.effects, *TRUE_ANYWAY)
        ]
        named = {cause.effect for cause in accused}
        lines += [f"{e} is in the arm, and not named" for e in self.effects if e not in named]
        own = [p for cause in accused if cause.effect in self.effects for p in cause.parameters]
        for name, value, std, _ in own:
            true = self.truth.get(name, 0.0)
            if abs(value - true) > SIGMAS * std + FLOOR:
                lines.append(
                    f"{name} is {value:.6f}, found with 1 sigma {std:.6f}: truly {true:.6f}"
                )
        return lines


def _bent_tool(rng: np.random.Generator) -> Hidden:
    way = rng.normal(size=3)
    shift = tuple(float(v) for v in way / np.linalg.norm(way) * rng.uniform(*SHIFTS))
    truth = {f"tool_frame_{axis}": v for axis, v in zip("xyz", shift, strict=True)}
    return Hidden(("tool_frame",), "the tool was bent, too", truth, {"tool_shift": shift})


def _lost_zero(rng: np.random.Generator) -> Hidden:
    joint, value = int(rng.choice(ZERO_JOINTS)), float(rng.uniform(*ZEROS))  # lower, as it bends
    zero = tuple(value if i + 1 == joint else 0.0 for i in range(6))
    truth = {f"joint_offset_{joint}": value}
    return Hidden(("joint_offset",), "the zero of a joint was off, too", truth, {"zero": zero})


def soft_servos(seed: int, held: Sequence[float]) -> Hidden:
    """Return servos that give way by some 5 mrad, and less, where they hold ``held`` (n,), Nm.

    A joint with less than a newton metre has a servo that stands.
    """
    rng = np.random.default_rng((seed, 31))
    share = rng.uniform(0.7, 1.0, len(held))
    droop = tuple(
        float(GIVES * s / h) if h > 1.0 else 0.0 for s, h in zip(share, held, strict=True)
    )
    truth = {f"servo_droop_{i + 1}": v for i, v in enumerate(droop) if v}
    return Hidden(("servo_droop",), "its servos give way", truth, {"droop": droop})


DRAWS: dict[str, Callable[[np.random.Generator], Hidden]] = {
    "bent_tool": _bent_tool, "lost_zero": _lost_zero,
}  # fmt: skip
"""What may be hidden: what the diagnosis names rightly whatever the seed."""


def accused_in(document: Mapping[str, Any]) -> tuple[Accused, ...]:
    """Return what a diagnosis accuses, from its JSON."""
    return tuple(
        Accused(
            cause["effect"], tuple(cause["joints"]),
            tuple((p["name"], p["value"], p["std"], p["unit"]) for p in cause["parameters"]),
        )
        for channel in document["channels"]
        for cause in channel["causes"]
    )  # fmt: skip
