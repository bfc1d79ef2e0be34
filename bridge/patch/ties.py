"""What a diagnosis could not distinguish, as lines for a patched model's comment."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.cell.schema import Accused
from gapbridge.core.effects import CATALOGUE, Term


def tie_lines(accused: Sequence[Accused], terms: Sequence[Term]) -> tuple[str, ...]:
    """Return one line for each accused effect that has ties and is in the model: both candidates.

    The accused one is in the model with its value; of the other it is said how people put it in
    and where its value comes from.
    """
    there = {(term.effect, term.site.joint) for term in terms if not term.stand_in}
    lines = []
    for cause in accused:
        joints: list[int | None] = [*cause.joints] or [None]
        if not cause.indistinguishable_from or not any((cause.effect, j) in there for j in joints):
            continue
        numbers = ", ".join(f"{p.name} = {p.value:.6g} {p.unit}".rstrip() for p in cause.parameters)
        others = " or ".join(
            f"{name} ({CATALOGUE[name].instead})" if _instead(name) else name
            for name in cause.indistinguishable_from
        )
        lines.append(
            f"tie: either {numbers}, which is written, or {others}: the data do not separate them; "
            f"the other's value: diagnose with --withhold {cause.effect}"
        )
    return tuple(lines)


def _instead(name: str) -> str:
    return CATALOGUE[name].instead if name in CATALOGUE else ""
