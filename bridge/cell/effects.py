"""Effects in a cell file and as terms of a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gapbridge.bridge.cell.message import nearest
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
from gapbridge.core.errors import CellError, InputError

VALUE = "value"  # the name in the file of a parameter that has none of its own


def term_of(entry: EffectEntry, arm: Arm, where: str) -> Term:
    """Return the term of one entry of ``effects``; raises CellError beginning with ``where``."""
    try:
        effect = effect_named(entry.effect)
    except InputError as error:
        raise CellError(f"{where}.{error}") from None
    sites = effect.sites(arm)
    joints = [site.joint for site in sites]
    if entry.joint not in joints:
        allowed = "no joint" if joints == [None] else f"a joint of {joints[0]} to {joints[-1]}"
        found = "none" if entry.joint is None else entry.joint
        raise CellError(f"{where}.joint: found {found}, expected {allowed} for {entry.effect}")
    if (entry.order is not None) != effect.periodic:
        raise CellError(
            f"{where}.order: found {'none' if entry.order is None else entry.order}, expected "
            f"{'cycles per turn' if entry.order is None else 'none'} for {entry.effect}"
        )
    site = Site(entry.joint, entry.order)
    parameters = effect.parameters(arm, site)
    names = [name_of(parameter) for parameter in parameters]
    for name in entry.parameters:
        if name not in names:
            raise CellError(
                f"{where}.parameters.{name}: found an unknown parameter of {entry.effect}; "
                f"{nearest(name, names)}"
            )
    values = [_value(entry, name, p, where) for name, p in zip(names, parameters, strict=True)]
    return Term(entry.effect, site, tuple(values), entry.stand_in)


def _value(entry: EffectEntry, name: str, parameter: Parameter, where: str) -> float:
    if name not in entry.parameters:
        raise CellError(f"{where}.parameters.{name}: found nothing, expected {parameter.unit}")
    value = entry.parameters[name]
    if not parameter.lower <= value <= parameter.upper:
        raise CellError(
            f"{where}.parameters.{name}: found {value:g}, expected {parameter.lower:g} to "
            f"{parameter.upper:g} {parameter.unit}"
        )
    return value


def name_of(parameter: Parameter) -> str:
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
                f"compliance.{key}: found {len(values)} values, expected {arm.n}: "
                f"the arm ({arm.name}) has {arm.n} joints"
            )
        terms += [Term(effect, Site(i + 1), (v,)) for i, v in enumerate(values) if v]
    return tuple(terms)


def compliance_entry(terms: Sequence[Term], n: int) -> dict[str, list[float]]:
    """Return the compliance section of a model's terms: n values per key."""
    entry = {key: np.zeros(n) for key in flexibility_effects()}
    for term in terms:
        key = CATALOGUE[term.effect].flexibility
        if _in_section(term) and term.site.joint is not None:
            entry[key][term.site.joint - 1] += term.values[0]
    # what is below zero is no flexibility: it stands among the effects
    return {key: np.maximum(values, 0.0).tolist() for key, values in entry.items()}


def _in_section(term: Term) -> bool:
    """Return whether a term belongs to the section; a stand-in keeps its mark among effects."""
    return bool(CATALOGUE[term.effect].flexibility) and not term.stand_in


def _negative_terms(terms: Sequence[Term]) -> list[Term]:
    """Return what a joint's flexibilities of one kind add up to, where that is below zero."""
    totals: dict[tuple[str, Site], float] = {}
    for term in terms:
        if _in_section(term):
            key = (term.effect, term.site)
            totals[key] = totals.get(key, 0.0) + term.values[0]
    return [Term(effect, site, (v,)) for (effect, site), v in totals.items() if v < 0]


def effect_entries(terms: Sequence[Term], arm: Arm) -> list[dict[str, Any]]:
    """Return the ``effects`` list of a model's terms; flexibilities stand in their own section."""
    entries = []
    further = [term for term in terms if not _in_section(term)]
    for term in (*_negative_terms(terms), *further):
        entry: dict[str, Any] = {"effect": term.effect}
        if term.site.joint is not None:
            entry["joint"] = term.site.joint
        if term.site.order is not None:
            entry["order"] = float(term.site.order)
        parameters = effect_named(term.effect).parameters(arm, term.site)
        names = [name_of(parameter) for parameter in parameters]
        entry["parameters"] = dict(zip(names, map(float, term.values), strict=True))
        if term.stand_in:
            entry["stand_in"] = True
        entries.append(entry)
    return entries
