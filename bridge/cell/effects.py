"""Conversion of effects between the cell file and the terms of a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gapbridge.bridge.cell.schema import Compliance, EffectEntry
from gapbridge.core.arm import Arm
from gapbridge.core.effects import (
    CATALOGUE,
    Parameter,
    Site,
    Term,
    effect_named,
    flexibility_effects,
)
from gapbridge.core.errors import CellError, InputError, Keys
from gapbridge.drivers.validation import suggestion

VALUE = "value"  # key in the file of a parameter without a name


def effect_terms(entries: Sequence[EffectEntry], arm: Arm) -> tuple[Term, ...]:
    """Return the terms of section ``effects``. Raises CellError.

    Effects at one joint add up, as a second ``--apply`` adds them; equal entries are a copy.
    """
    terms: list[Term] = []
    for i, entry in enumerate(entries):
        term = term_from_entry(entry, arm, ("effects", i))
        if term in terms:
            raise CellError(
                f"found the same {entry.effect} as in entry {terms.index(term) + 1}, expected it "
                "once",
                ("effects", i),
            )
        terms.append(term)
    return tuple(terms)


def term_from_entry(entry: EffectEntry, arm: Arm, keys: Keys) -> Term:
    """Return the term of the entry of ``effects`` at ``keys``. Raises CellError."""
    try:
        effect = effect_named(entry.effect)
    except InputError as error:
        raise CellError(error.message, (*keys, "effect")) from None
    sites = effect.sites(arm)
    joints = [site.joint for site in sites]
    if entry.joint not in joints:
        allowed = "no joint" if joints == [None] else f"a joint of {joints[0]} to {joints[-1]}"
        joint = "none" if entry.joint is None else entry.joint
        raise CellError(f"found {joint}, expected {allowed} for {entry.effect}", (*keys, "joint"))
    if (entry.order is not None) != effect.periodic:
        raise CellError(
            f"found {'none' if entry.order is None else entry.order}, expected "
            f"{'cycles per turn' if entry.order is None else 'none'} for {entry.effect}",
            (*keys, "order"),
        )
    site = Site(entry.joint, entry.order)
    parameters = effect.parameters(arm, site)
    names = [file_key(parameter) for parameter in parameters]
    if parameters[-1].optional and names[-1] not in entry.parameters:
        parameters = parameters[:-1]
    for name in entry.parameters:
        if name not in names:
            raise CellError(
                f"found an unknown parameter of {entry.effect}; {suggestion(name, names)}",
                (*keys, "parameters", name),
            )
    values = [_checked_value(entry, file_key(p), p, keys) for p in parameters]
    return Term(entry.effect, site, tuple(values), entry.stand_in)


def _checked_value(entry: EffectEntry, name: str, parameter: Parameter, keys: Keys) -> float:
    keys = (*keys, "parameters", name)
    if name not in entry.parameters:
        raise CellError(f"found nothing, expected {parameter.unit}", keys)
    value = entry.parameters[name]
    if not parameter.lower <= value <= parameter.upper:
        raise CellError(
            f"found {value:g}, expected {parameter.lower:g} to {parameter.upper:g} "
            f"{parameter.unit}",
            keys,
        )
    return value


def file_key(parameter: Parameter) -> str:
    """Return a parameter's name in the cell file."""
    return parameter.name or VALUE


def compliance_terms(compliance: Compliance, arm: Arm) -> tuple[Term, ...]:
    """Return the terms of the compliance section; zeros are left out."""
    terms = []
    for key, effect in flexibility_effects().items():
        values = getattr(compliance, key)
        if values is None:
            continue
        if len(values) != arm.n:
            raise CellError(
                f"found {len(values)} values, expected {arm.n}: the arm ({arm.name}) has "
                f"{arm.n} joints",
                ("compliance", key),
            )
        terms += [Term(effect, Site(i + 1), (v,)) for i, v in enumerate(values) if v]
    return tuple(terms)


def compliance_entry(terms: Sequence[Term], n: int) -> dict[str, list[float]]:
    """Return the compliance section of a model's terms: n values per key."""
    entry = {key: np.zeros(n) for key in flexibility_effects()}
    for term in terms:
        key = CATALOGUE[term.effect].flexibility
        if _is_compliance_entry(term) and term.site.joint is not None:
            entry[key][term.site.joint - 1] += term.values[0]
    # a negative sum is no flexibility: effect_entries lists it
    return {key: np.maximum(values, 0.0).tolist() for key, values in entry.items()}


def _is_compliance_entry(term: Term) -> bool:
    """Return whether a term is written in the compliance section; stand-ins are effects."""
    return bool(CATALOGUE[term.effect].flexibility) and not term.stand_in


def _negative_terms(terms: Sequence[Term]) -> list[Term]:
    """Return the sums of each joint's flexibilities of one kind, where negative."""
    totals: dict[tuple[str, Site], float] = {}
    for term in terms:
        if _is_compliance_entry(term):
            key = (term.effect, term.site)
            totals[key] = totals.get(key, 0.0) + term.values[0]
    return [Term(effect, site, (v,)) for (effect, site), v in totals.items() if v < 0]


def effect_entries(terms: Sequence[Term], arm: Arm) -> list[dict[str, Any]]:
    """Return the ``effects`` list of a model's terms; flexibilities have their own section."""
    entries = []
    others = [term for term in terms if not _is_compliance_entry(term)]
    for term in (*_negative_terms(terms), *others):
        entry: dict[str, Any] = {"effect": term.effect}
        if term.site.joint is not None:
            entry["joint"] = term.site.joint
        if term.site.order is not None:
            entry["order"] = float(term.site.order)
        parameters = effect_named(term.effect).parameters(arm, term.site)
        names = [file_key(parameter) for parameter in parameters[: len(term.values)]]
        entry["parameters"] = dict(zip(names, map(float, term.values), strict=True))
        if term.stand_in:
            entry["stand_in"] = True
        entries.append(entry)
    return entries
