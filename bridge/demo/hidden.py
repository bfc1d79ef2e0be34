"""What is hidden in the demo's arm beside its flexibilities: an effect that no fit knows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

SHIFTS = (1.0e-3, 2.5e-3)  # m, of a tool that hit something
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
    """An effect of the arm that the demo's cell does not know.

    effect: as the diagnosis names it; about: what happened, for people.
    truth: its true numbers by the names of the diagnosis, SI.
    simulation: the same as keys of a cell's section ``simulation``, fields of PlantSettings.
    """

    effect: str
    about: str
    truth: Mapping[str, float]
    simulation: Mapping[str, tuple[float, ...]]

    @classmethod
    def drawn(cls, seed: int, among: tuple[str, ...]) -> Hidden:
        """Return one of the effects ``among``, which and how large drawn from the seed."""
        rng = np.random.default_rng((seed, 29))
        return DRAWS[among[int(rng.integers(len(among)))]](rng)

    def denials(self, accused: Iterable[Accused]) -> list[str]:
        """Return a line for each accusation that the truth does not hold, and for what is missing.

        A number is held by the truth within SIGMAS of its own standard deviation and FLOOR.
        """
        accused = list(accused)
        lines = [
            f"{cause.effect} is accused, and this arm has none"
            for cause in accused
            if cause.effect not in (self.effect, *TRUE_ANYWAY)
        ]
        own = [p for cause in accused if cause.effect == self.effect for p in cause.parameters]
        if not own:
            return [*lines, f"{self.effect} is in the arm, and not named"]
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
    return Hidden("tool_frame", "the tool was bent, too", truth, {"tool_shift": shift})


DRAWS: dict[str, Callable[[np.random.Generator], Hidden]] = {"tool_frame": _bent_tool}
"""Effects that may be hidden: those that the diagnosis names rightly whatever the seed."""


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
