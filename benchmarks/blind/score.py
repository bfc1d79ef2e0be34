"""Scores one diagnosis (its JSON) against the truth of its case."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.blind.cases import group_of
from benchmarks.blind.hidden import SAME, Claim, Hidden, claims_of
from benchmarks.blind.label import Label

NOWHERE = "not in the catalogue"
UNLIKE = 100.0  # chi-square from which on a tie told is no tie


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
    outcome: str  # right | right_tie | tie_untold | abstained | missed | wrong | failed
    false: tuple[str, ...] = ()  # effects accused that are neither true nor a true twin
    joints_right: bool | None = None
    owned_up: bool = False  # unexplained and structured
    depends_right: bool | None = None
    z: dict[str, float] = field(default_factory=dict)
    remainder: float | None = None  # held out, over the true floor
    needless_ties: tuple[str, ...] = ()
    seconds: float | None = None
    message: str = ""
    label: Label | None = None

    @property
    def ok(self) -> bool:
        """Return whether the answer was right, or a tie told that holds the truth."""
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
    unknown = bool(label.withhold) or label.outside is not None
    if unknown:
        verdict = _unknown(label, claims, structured)
    elif not label.causes:
        clean = not claims and not structured
        verdict = Verdict("right" if clean else "wrong", tuple(c.effect for c in claims))
    else:
        verdict = _known(label, claims, causes)
        if verdict.outcome == "abstained" and structured and label.facts.get("settling_drift"):
            verdict = Verdict("right_tie")  # a drift that settles may be owned up to as another
    explained = group in ("clean", "known", "several") and verdict.outcome in ("right", "right_tie")
    held_out = own.get("remaining_rms_held_out") or own.get("remaining_rms")
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
        owned_up=structured,
        depends_right=_depends(label, unexplained) if unknown else None,
        z=_z_scores(label, causes) if exact else {},
        remainder=held_out / label.floor_rms if explained and held_out is not None else None,
        needless_ties=verdict.needless,
        seconds=seconds,
        label=label,
    )


@dataclass(frozen=True)
class Verdict:
    """The part of a score that the accusations decide."""

    outcome: str
    false: tuple[str, ...] = ()
    joints_right: bool | None = None
    needless: tuple[str, ...] = ()


def _true_claims(label: Label) -> tuple[Claim, ...]:
    out = []
    for cause in label.causes:
        orders = {float(m[1]) for n in cause.parameters if (m := re.search(r"order([0-9.]+)", n))}
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
    if named > label.effects or not _same_data(truth, claims, hidden):
        return Verdict("wrong", tuple(sorted(named - label.effects)), False)
    told = {str(e) for c in causes for e in c.get("indistinguishable_from") or []}
    outcome = "right_tie" if label.effects - named <= told else "tie_untold"
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
        # what all joints have alike may be told of the arm as a whole
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
    """Return ties told that the data rule out: the other effect in no place makes the data."""
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
    if claims:
        if label.withhold and _same_data(
            _true_claims(label), claims, Hidden(label.kind, label.seed)
        ):
            return Verdict("right_tie")
        return Verdict("wrong", tuple(sorted(c.effect for c in claims)))
    return Verdict("right" if structured else "missed")


def _depends(label: Label, unexplained: dict[str, Any]) -> bool | None:
    told = [str(d["quantity"]) for d in unexplained.get("depends_on") or []][:3]
    true = label.depends_on
    if not true:
        true = _plain_columns(label) or Hidden(label.kind, label.seed).columns_that_matter()
    return bool(set(told) & set(true)) if true else None


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
    """Return (estimate - truth) / std of every parameter that is told with a std."""
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
