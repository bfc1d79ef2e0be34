"""Scores one diagnosis (its JSON) against the truth of its case."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.blind.beyond import true_beyond
from benchmarks.blind.cases import Static, group_of
from benchmarks.blind.hidden import SAME, Claim, Hidden, Place, claims_of
from benchmarks.blind.label import Label

NOWHERE = "not in the catalogue"
EXPLAINED = ("clean", "known", "several", "many", "arm", "sessions", "laid_out")
UNLIKE = 100.0  # chi-square from which on a tie reported is no tie
NEAR = 0.02  # of a withheld effect's squares: what a near twin leaves, 14 % of its size


@dataclass(frozen=True)
class CaseScore:
    """What one diagnosis was worth."""

    kind: str
    group: str
    seed: int
    arm: str
    channel: str
    put_in: tuple[str, ...]
    named: tuple[str, ...]
    outcome: str  # right | right_tie | tie_untold | abstained | missed | wrong | failed;
    # mixed also: partly (some known effects) | unadmitted (the remainder passed over); withheld
    # also: first_order (a near twin, or at the same joints with the rest admitted)
    false: tuple[str, ...] = ()  # effects accused that are neither true nor a true twin
    joints_right: bool | None = None
    admitted: bool = False  # unexplained and structured
    depends_right: bool | None = None
    z: dict[str, float] = field(default_factory=dict)
    moments: tuple[bool, ...] = ()  # of each slip named: within one row of the true one
    remainder: float | None = None  # held out, over the true floor
    needless_ties: tuple[str, ...] = ()
    seconds: float | None = None
    message: str = ""
    label: Label | None = None
    known: int = 0  # effects put in beside a remainder
    known_named: int = 0
    reported_beyond: float | None = None  # what is reported to remain in a region not fitted, unit
    true_beyond: float | None = None  # what truly remains there

    @property
    def ok(self) -> bool:
        """Return whether the answer was right, or a tie reported that holds the truth."""
        return self.outcome in ("right", "right_tie")


def failed(label: Label, message: str, seconds: float | None) -> CaseScore:
    """Return the score of a diagnosis that came to no answer."""
    return CaseScore(
        label.kind, group_of(label.kind), label.seed, label.arm, label.channel,
        tuple(sorted(label.effects)) or _what(label), (), "failed", seconds=seconds,
        message=message, label=label,
    )  # fmt: skip


def _what(label: Label) -> tuple[str, ...]:
    return (label.outside,) if label.outside else ()


def score(label: Label, diagnosis: dict[str, Any], seconds: float | None = None) -> CaseScore:
    """Return the score of a diagnosis."""
    channels = {c["channel"]: c for c in diagnosis.get("channels", [])}
    own = channels.get(label.channel)
    if own is None:
        return failed(label, f"the diagnosis has no channel {label.channel}", seconds)
    elsewhere = [c for name, d in channels.items() if name != label.channel for c in d["causes"]]
    causes = list(own["causes"]) + elsewhere
    claims = claims_of(causes)
    unexplained = own.get("unexplained") or {}
    structured = bool(unexplained.get("structured"))
    group = group_of(label.kind)
    mixed = bool(label.causes) and label.outside is not None
    unknown = bool(label.withhold) or label.outside is not None
    if mixed:
        verdict = _mixed(label, claims, causes, structured)
    elif unknown:
        verdict = _unknown(label, claims, structured)
    elif not label.causes:
        clean = not claims and not structured
        verdict = Verdict("right" if clean else "wrong", tuple(c.effect for c in claims))
    else:
        verdict = _known(label, claims, causes)
        if verdict.outcome == "abstained" and structured and label.facts.get("settling_drift"):
            verdict = Verdict("right_tie")  # a drift that settles may be reported as another
    explained = group in EXPLAINED and verdict.outcome in ("right", "right_tie")
    held_out = own.get("remaining_rms_held_out") or own.get("remaining_rms")
    reported_beyond = own.get("remaining_rms_new_region") if label.facts.get("beyond") else None
    exact = verdict.outcome == "right" and _same_joints(label, claims)
    exact = exact and not label.facts.get("settling_drift")
    return CaseScore(
        kind=label.kind,
        group=group,
        seed=label.seed,
        arm=label.arm,
        channel=label.channel,
        put_in=tuple(sorted(label.effects)) or _what(label),
        named=tuple(sorted(c.effect for c in claims)),
        outcome=verdict.outcome,
        false=verdict.false,
        joints_right=verdict.joints_right,
        admitted=structured,
        depends_right=_depends(label, unexplained) if unknown else None,
        z=_z_scores(label, _of_named(label, causes) if mixed else causes) if exact or mixed else {},
        moments=_moments(label, causes),
        remainder=held_out / label.floor_rms if explained and held_out is not None else None,
        needless_ties=verdict.needless,
        seconds=seconds,
        label=label,
        known=len(label.effects) if mixed else 0,
        known_named=verdict.named if mixed else 0,
        reported_beyond=reported_beyond,
        true_beyond=None if reported_beyond is None else true_beyond(label, causes),
    )


@dataclass(frozen=True)
class Verdict:
    """The part of a score that the accusations decide."""

    outcome: str
    false: tuple[str, ...] = ()
    joints_right: bool | None = None
    needless: tuple[str, ...] = ()
    named: int = 0  # of the known effects of a mixed case


def _mixed(
    label: Label, claims: tuple[Claim, ...], causes: list[dict[str, Any]], structured: bool
) -> Verdict:
    """Return the verdict of known effects beside a remainder.

    Right is: all known effects named where they are, nothing else but the remainder's first
    order, and residual structure. What makes the data of the known effects as well is no error.
    """
    truth = {p for c in _true_claims(label) for p in c.places}
    own = [(c, p) for c in claims for p in c.places if p not in label.akin]
    extra = [p for _, p in own if p not in truth and (p[0], None) not in truth]
    there = {e for e in label.effects if _places_of(e, truth) <= {p for _, p in own}
             or (e, None) in {p for _, p in own}}  # fmt: skip
    if extra or there != label.effects:
        rest = tuple(Claim(c.effect, (p[1],) if p[1] is not None else (), c.orders)
                     for c, p in own)  # fmt: skip
        if rest and _same_data(_true_claims(label), rest, Hidden(label.kind, label.seed)):
            there, extra = set(label.effects), []
    reported = {str(c["effect"]): {str(e) for e in c.get("indistinguishable_from") or []}
            for c in causes}  # fmt: skip
    lost = label.effects - there
    tied = {e for e in lost if any(e in reported.get(p[0], ()) for p in extra)}
    extra = [p for p in extra if not reported.get(p[0], set()) & tied]
    false = tuple(sorted({p[0] for p in extra}))
    named = len(there | tied)
    if false:
        return Verdict("wrong", false, named=named)
    if named < len(label.effects):
        return Verdict("abstained" if not claims else "partly", named=named)
    outcome = ("right_tie" if tied else "right") if structured else "unadmitted"
    return Verdict(outcome, named=named)


def _places_of(effect: str, places: Iterable[Place]) -> set[Place]:
    return {p for p in places if p[0] == effect}


def _of_named(label: Label, causes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the accusations of true effects at their true joints alone."""
    joints = {c.effect: set(c.joints) for c in label.causes}
    return [c for c in causes if joints.get(c["effect"]) == {int(j) for j in c.get("joints") or []}]


def _true_claims(label: Label) -> tuple[Claim, ...]:
    out = []
    for cause in label.causes:
        orders = {float(m[1]) for n in cause.parameters if (m := re.search(r"order([0-9.]+)", n))}
        orders |= {v for n, v in cause.parameters.items() if n.endswith("_time")}
        out.append(Claim(cause.effect, cause.joints, tuple(sorted(orders))))
    return tuple(out)


def _known(label: Label, claims: tuple[Claim, ...], causes: list[dict[str, Any]]) -> Verdict:
    truth = _true_claims(label)
    named = {c.effect for c in claims}
    if not claims:
        return Verdict("abstained")
    hidden = Hidden(label.kind, label.seed)
    if named == label.effects:
        joints = _joints_right(truth, claims, hidden)
        return Verdict("right", (), joints, _needless(truth, claims, causes, hidden))
    more = (
        named - label.effects
    )  # at one joint alone it may be named for an effect of others, as a tie
    tied = all(label.effects & {*(c.get("indistinguishable_from") or [])}
               for c in causes if c["effect"] in more)  # fmt: skip
    if (named > label.effects and not tied) or not _same_data(truth, claims, hidden):
        return Verdict("wrong", tuple(sorted(more)), False)
    reported = {str(e) for c in causes for e in c.get("indistinguishable_from") or []}
    outcome = "right_tie" if label.effects - named <= reported else "tie_untold"
    return Verdict(outcome, () if outcome == "right_tie" else tuple(sorted(named - label.effects)))


def _same_data(truth: tuple[Claim, ...], claims: tuple[Claim, ...], hidden: Hidden) -> bool:
    """Return whether the claims, no richer than the truth, make the same data."""
    places = sum(len(c.places) for c in claims), sum(len(c.places) for c in truth)
    richer = places[0] > places[1] and hidden.size_of(claims) > hidden.size_of(truth)
    return not richer and hidden.left_over(claims) < SAME


def _joints_right(truth: tuple[Claim, ...], claims: tuple[Claim, ...], hidden: Hidden) -> bool:
    """Return whether the joints are the true ones, or ones that make the same data."""
    by_effect = {c.effect: c.joints for c in claims}

    def agree(cause: Claim) -> bool:
        # what all joints have alike may be reported of the arm as a whole
        return by_effect[cause.effect] in (cause.joints, ()) or not cause.joints

    if all(agree(c) for c in truth):
        return True
    count = sum(len(c.joints) for c in claims) <= sum(len(c.joints) for c in truth)
    return count and hidden.left_over(claims) < SAME


def _same_joints(label: Label, claims: tuple[Claim, ...]) -> bool:
    """Return whether parameters can be compared name by name."""
    named = {c.effect: c.joints for c in claims}
    return all(named.get(c.effect) in (c.joints, ()) or not c.joints for c in label.causes)


def _needless(
    truth: tuple[Claim, ...], claims: tuple[Claim, ...], causes: list[dict[str, Any]],
    hidden: Hidden,
) -> tuple[str, ...]:  # fmt: skip
    """Return ties reported that the data rule out: the other effect in no place makes the data."""
    out = []
    for cause in causes:
        rest = [c for c in truth if c.effect != cause["effect"]]
        for other in cause.get("indistinguishable_from") or []:
            joints = {j for c in claims if c.effect == cause["effect"] for j in c.joints}
            near = {k for j in joints for k in (j - 1, j, j + 1) if k >= 1}
            options = [Claim(str(other), ())] + [Claim(str(other), (j,)) for j in sorted(near)]
            lefts = [hidden.left_over([*rest, o]) for o in options]
            if min(lefts) > UNLIKE:
                out.append(f"{cause['effect']}~{other}")
    return tuple(out)


def _unknown(label: Label, claims: tuple[Claim, ...], structured: bool) -> Verdict:
    if not claims:
        return Verdict("right" if structured else "missed")
    if label.withhold:
        truth, hidden = _true_claims(label), Hidden(label.kind, label.seed)
        if _same_data(truth, claims, hidden):
            return Verdict("right_tie")
        joints = {j for c in truth for j in c.joints}
        there = {j for c in claims for j in c.joints} <= joints
        near = hidden.left_over(claims) < NEAR * hidden.left_over(())
        if near or (structured and there):
            return Verdict("first_order")
    return Verdict("wrong", tuple(sorted(c.effect for c in claims)))


def _depends(label: Label, unexplained: dict[str, Any]) -> bool | None:
    reported = [str(d["quantity"]) for d in unexplained.get("depends_on") or []][:3]
    true = label.depends_on
    if not true:
        true = _plain_columns(label) or Hidden(label.kind, label.seed).columns_that_matter()
    return bool(set(reported) & set(true)) if true else None


def _plain_columns(label: Label) -> tuple[str, ...]:
    """Return the columns of withheld effects that plainly go by one quantity; else nothing."""
    out: list[str] = []
    for cause in label.causes:
        if cause.effect == "thermal_drift":
            out += ["timestamp", *(f"joint_temperatures_{i}" for i in range(7))]
        elif cause.effect in ("backlash", "transmission_error"):
            column = "approach" if cause.effect == "backlash" else "actual_q"
            out += [f"{column}_{j - 1}" for j in cause.joints]
        elif cause.effect == "ft_drift":
            out.append("timestamp")
        elif cause.effect in ("coulomb_friction", "viscous_friction"):
            out += [f"actual_qd_{j - 1}" for j in cause.joints]
    return tuple(out)


def _z_scores(label: Label, causes: list[dict[str, Any]]) -> dict[str, float]:
    """Return (estimate - truth) / std of every parameter that is reported with a std."""
    true = {_key(n): v for c in label.causes for n, v in c.parameters.items()}
    out = {}
    for cause in causes:
        for parameter in cause.get("parameters") or []:
            std = parameter.get("std")
            value = parameter.get("value")
            if not std or value is None or not np.isfinite(std):
                continue
            key = _nearest(_key(str(parameter["name"])), true)
            if key is None and not _belongs(parameter["name"], label):
                continue
            off = float(value) - (true[key] if key else 0.0)
            if str(parameter["name"]).endswith("phase"):
                off = (off + np.pi) % (2 * np.pi) - np.pi
            out[str(parameter["name"])] = off / float(std)
    return out


def _moments(label: Label, causes: list[dict[str, Any]]) -> tuple[bool, ...]:
    """Return whether the moment of each slip at its true joint is within one row of the true one.

    Two moments between the same two rows are the same: the log cannot tell them apart.
    """
    true = {n: v for c in label.causes for n, v in c.parameters.items() if n.endswith("_time")}
    named = {
        str(p["name"]): float(p["value"])
        for c in _of_named(label, causes) for p in c.get("parameters") or []
        if p["name"] in true and p.get("value") is not None
    }  # fmt: skip
    if not named:
        return ()
    case = Hidden(label.kind, label.seed).case
    assert isinstance(case, Static)
    rows = np.sort(case.drawn.bench.session.time)
    at = {n: np.searchsorted(rows, [true[n], value]) for n, value in named.items()}
    return tuple(bool(abs(a - b) <= 1) for a, b in at.values())


def _belongs(name: str, label: Label) -> bool:
    """Return whether a parameter is one that the truth leaves at zero (another axis, another key).

    A name that the truth does not know at all is not scored.
    """
    several = ("link_geometry", "tool_frame", "ft_bias", "ft_drift", "ft_gain", "ft_misalignment")
    return any(name.startswith(e) for e in several if e in label.effects)


def _key(name: str) -> tuple[str, float]:
    """Return a parameter's name without its order, and the order."""
    found = re.search(r"_order_?([0-9.]+)", name)
    return (name.replace(found[0], "_order"), float(found[1])) if found else (name, 0.0)


def _nearest(
    key: tuple[str, float], true: dict[tuple[str, float], float]
) -> tuple[str, float] | None:
    same = [k for k in true if k[0] == key[0]]
    close = [k for k in same if abs(k[1] - key[1]) <= 0.02 * max(k[1], 1.0)]
    return min(close, key=lambda k: abs(k[1] - key[1])) if close else None
