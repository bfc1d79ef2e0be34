"""What the scorer alone may know of a case: its truth as a function, for the twin experiment."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks.blind import twins
from benchmarks.blind.bench import combined
from benchmarks.blind.cases import Static, drawn_case
from benchmarks.blind.channel_cases import ChannelCase
from benchmarks.blind.measuring import without
from benchmarks.blind.mechanics import Session

Place = tuple[str, int | None]
SAME = twins.SAME


@dataclass(frozen=True)
class Claim:
    """One accusation of a diagnosis: an effect, where, and the orders of its lines."""

    effect: str
    joints: tuple[int, ...]
    orders: tuple[float, ...] = ()  # of a slip: its moments, s

    @property
    def places(self) -> tuple[Place, ...]:
        """Return the claim joint by joint."""
        return tuple((self.effect, j) for j in self.joints) or ((self.effect, None),)


class Hidden:
    """The truth behind one case, drawn anew from its kind and seed."""

    def __init__(self, kind: str, seed: int) -> None:
        """Draw the case again; nothing is read from its folder."""
        self.case: Static | ChannelCase = drawn_case(kind, seed)[0]

    def size_of(self, claims: Iterable[Claim]) -> int:
        """Return how many numbers the claims may choose."""
        return sum(self._columns(c) for c in claims)

    def _columns(self, claim: Claim) -> int:
        if isinstance(self.case, ChannelCase):
            known = self.case.truth.candidates
            return sum(len(known[p].scale) for p in self._resolved(claim) if p in known)
        return sum(
            len(twins.probes(self.case.drawn.bench, e, j, claim.orders or (1.0, 2.0)))
            for e, j in claim.places
        )

    def _resolved(self, claim: Claim) -> tuple[Place, ...]:
        """Return a claim's places as the truth names them: no joint stands for all joints."""
        assert isinstance(self.case, ChannelCase)
        known = self.case.truth.candidates
        if (claim.effect, None) in known:
            return ((claim.effect, None),)
        if not claim.joints:
            return tuple(p for p in known if p[0] == claim.effect)
        return claim.places

    def left_over(self, claims: Iterable[Claim]) -> float:
        """Return the chi-square that the best version of the claims leaves of the true gap.

        Of a mixed case it is the gap of its known effects alone. Claims that the truth cannot
        make sense of (unknown effect or joint) explain nothing.
        """
        claims = list(claims)
        if isinstance(self.case, ChannelCase):
            places = [p for c in claims for p in self._resolved(c)]
            return self.case.truth.left_over(self.case.known_gap, places)
        strange = self.case.strange
        mixed = strange is not None and strange.known_gap is not None
        gap = strange.known_gap if strange is not None and mixed else self.case.gap
        assert gap is not None
        hypotheses = [(e, j, c.orders or (1.0, 2.0)) for c in claims for e, j in c.places]
        try:
            bench = self.case.drawn.bench
            shared = [p for p in self.case.drawn.parts
                      if any((p.effect, p.joint) in c.places for c in claims)]  # fmt: skip
            return twins.left_over(bench, gap, hypotheses, combined(bench, shared))
        except (ValueError, IndexError):
            return float("inf")

    def columns_that_matter(self) -> tuple[str, ...]:
        """Return the log columns whose shuffling changes the true gap most (total effect)."""
        if isinstance(self.case, ChannelCase):
            return ()
        bench, real = self.case.drawn.bench, self.case.drawn.real
        frame = bench.frame()
        gap = without(frame, bench.whitened_gap(real))
        rng = np.random.default_rng(0)
        effect: dict[str, float] = {}
        for column in _session_columns(bench.session):
            session = bench.session.permuted(column, rng)
            other = without(frame, bench.whitened_gap(real, session))
            effect[column] = float(np.sum((gap - other) ** 2))
        most = max(effect.values())
        found = tuple(c for c, e in effect.items() if e > 0.3 * most)
        warm = any(c.startswith("joint_temperatures") for c in found)
        return (*found, "timestamp") if warm else found


def _session_columns(session: Session) -> list[str]:
    n = session.q.shape[1]
    names = [f"{c}_{i}" for c in ("actual_q", "joint_temperatures", "approach") for i in range(n)]
    forces = [f"actual_TCP_force_{i}" for i in range(6)]
    return [*names, *forces, "payload", *(f"payload_cog_{i}" for i in range(3))]


def claims_of(causes: Iterable[dict]) -> tuple[Claim, ...]:  # type: ignore[type-arg]
    """Return the accusations of a diagnosis' JSON, one per effect, joints put together."""
    joints: dict[str, set[int]] = {}
    orders: dict[str, set[float]] = {}
    for cause in causes:
        effect = str(cause["effect"])
        joints.setdefault(effect, set()).update(int(j) for j in cause.get("joints") or [])
        for parameter in cause.get("parameters") or []:
            found = re.search(r"order_?([0-9.]+)", str(parameter["name"]))
            if str(parameter["name"]).endswith("_time") and parameter.get("value") is not None:
                orders.setdefault(effect, set()).add(float(parameter["value"]))
            elif found:
                orders.setdefault(effect, set()).add(float(found[1]))
    return tuple(
        Claim(e, tuple(sorted(j)), tuple(sorted(orders.get(e, ())))) for e, j in joints.items()
    )
