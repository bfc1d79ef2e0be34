"""What is true of a case. Labels stay in the scorer's memory; no case folder ever holds one."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Cause:
    """One effect that is in the data, with its joints (from 1) and true parameters."""

    effect: str
    joints: tuple[int, ...]
    parameters: dict[str, float]


@dataclass(frozen=True)
class Label:
    """The truth of one case."""

    kind: str
    seed: int
    arm: str
    channel: str
    causes: tuple[Cause, ...]
    floor_rms: float  # noise per coordinate, in the channel's unit
    gap_rms: float  # of the causes alone, frames taken out, per coordinate
    depends_on: tuple[str, ...] = ()  # columns that an effect outside the catalogue depends on
    outside: str | None = None  # what it is, where it stands in no catalogue
    withhold: tuple[str, ...] = ()  # effects to take out of the catalogue
    akin: tuple[tuple[str, int | None], ...] = ()  # what the unknown holds at first order
    twins: tuple[tuple[str, str], ...] = ()  # (effect, why it is the same here), known beforehand
    facts: dict[str, str | float | bool] = field(default_factory=dict)  # how the case was laid out

    @property
    def effects(self) -> frozenset[str]:
        """Return the names of the causes."""
        return frozenset(c.effect for c in self.causes)
