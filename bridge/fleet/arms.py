"""The sessions of each arm in their order in time."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.fleet.session import natural
from gapbridge.bridge.fleet.task import DONE, Outcome


def usable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes with a result."""
    return [o for o in outcomes if o.state == DONE]


def by_arm(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Return the usable sessions of each arm: by date where all have one, else by name."""
    found: dict[str, list[Outcome]] = {}
    for outcome in usable(outcomes):
        found.setdefault(outcome.arm, []).append(outcome)
    for arm, sessions in found.items():
        dated = all(o.result["time"] is not None for o in sessions)
        found[arm] = sorted(
            sessions,
            key=lambda o: (o.result["time"] if dated else 0.0, natural(o.session)),
        )
    return {arm: found[arm] for arm in sorted(found, key=natural)}
