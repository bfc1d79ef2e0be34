"""The catalogue of effects: one table; each member is a file in its channel's folder."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

from gapbridge.core.effects.effect import (
    CHANNELS,
    Effect,
    Parameter,
    ParameterName,
    Reported,
    Site,
    Term,
)
from gapbridge.core.effects.load.payload import Payload
from gapbridge.core.effects.load.payload_cog import PayloadCog
from gapbridge.core.effects.position.axial_compliance import AxialCompliance
from gapbridge.core.effects.position.backlash import Backlash
from gapbridge.core.effects.position.base_compliance import BaseCompliance
from gapbridge.core.effects.position.gravity_direction import GravityDirection
from gapbridge.core.effects.position.joint_offset import JointOffset
from gapbridge.core.effects.position.joint_slip import JointSlip
from gapbridge.core.effects.position.link_flexibility import LinkFlexibility
from gapbridge.core.effects.position.link_geometry import LinkGeometry
from gapbridge.core.effects.position.radial_compliance import RadialCompliance
from gapbridge.core.effects.position.stiffness_nonlinearity import StiffnessNonlinearity
from gapbridge.core.effects.position.target_slip import TargetSlip
from gapbridge.core.effects.position.thermal_drift import ThermalDrift
from gapbridge.core.effects.position.tool_frame import ToolFrame
from gapbridge.core.effects.position.transmission_error import TransmissionError
from gapbridge.core.effects.torque.coulomb_friction import CoulombFriction
from gapbridge.core.effects.torque.link_cog import LinkCog
from gapbridge.core.effects.torque.link_inertia import LinkInertia
from gapbridge.core.effects.torque.load_friction import LoadFriction
from gapbridge.core.effects.torque.rotor_inertia import RotorInertia
from gapbridge.core.effects.torque.stribeck_friction import StribeckFriction
from gapbridge.core.effects.torque.torque_constant import TorqueConstant
from gapbridge.core.effects.torque.torque_offset import TorqueOffset
from gapbridge.core.effects.torque.viscous_friction import ViscousFriction
from gapbridge.core.effects.tracking.dead_band import DeadBand
from gapbridge.core.effects.tracking.latency import Latency
from gapbridge.core.effects.tracking.servo_droop import ServoDroop
from gapbridge.core.effects.tracking.tracking_lag import TrackingLag
from gapbridge.core.effects.wrench.ft_bias import FtBias
from gapbridge.core.effects.wrench.ft_drift import FtDrift
from gapbridge.core.effects.wrench.ft_gain import FtGain
from gapbridge.core.effects.wrench.ft_misalignment import FtMisalignment
from gapbridge.core.errors import InputError

CATALOGUE: dict[str, Effect] = {
    effect.identifier: effect
    for effect in (
        JointOffset(),
        JointSlip(),
        LinkGeometry(),
        ToolFrame(),
        TargetSlip(),
        TransmissionError(),
        AxialCompliance(),
        RadialCompliance(),
        LinkFlexibility(),
        StiffnessNonlinearity(),
        BaseCompliance(),
        GravityDirection(),
        Payload(),
        PayloadCog(),
        Backlash(),
        ThermalDrift(),
        FtBias(),
        FtDrift(),
        FtGain(),
        FtMisalignment(),
        Latency(),
        TrackingLag(),
        ServoDroop(),
        DeadBand(),
        CoulombFriction(),
        ViscousFriction(),
        StribeckFriction(),
        LoadFriction(),
        TorqueOffset(),
        RotorInertia(),
        LinkInertia(),
        LinkCog(),
        TorqueConstant(),
    )
}


def ties_of(identifier: str) -> dict[str, str]:
    """Return the effects that look the same on some data as this one, and on which data."""
    equivalents = dict(CATALOGUE[identifier].equivalents)
    for name, effect in CATALOGUE.items():
        if identifier in effect.equivalents:
            equivalents[name] = effect.equivalents[identifier]
    return equivalents


def flexibility_effects() -> dict[str, str]:
    """Return the effect behind each key of a cell's compliance section: axial, radial."""
    return {e.flexibility: name for name, e in CATALOGUE.items() if e.flexibility}


def flexibility_names(n: int) -> list[str]:
    """Return the names of the 2n linear flexibilities of an arm of n joints, axial then radial."""
    named = flexibility_effects()
    return [f"{named[kind]}_{i + 1}" for kind in ("axial", "radial") for i in range(n)]


def correcting(what: str) -> tuple[str, ...]:
    """Return the effects that correct one thing a cell declares: "payload", "tool", ..."""
    return tuple(name for name, effect in CATALOGUE.items() if effect.replaces_cell_value == what)


def acting(terms: Iterable[Term], channel: str) -> list[Term]:
    """Return the terms that show in a channel, in the order in which they act there.

    On the way from load to reading: whatever order they were found in.
    """
    own = [t for t in terms if channel in CATALOGUE[t.effect].channels]
    return sorted(own, key=lambda term: CATALOGUE[term.effect].order)


def settling(terms: Iterable[Term]) -> list[Term]:
    """Return the terms by which encoders rest elsewhere than commanded, in order of action."""
    own = Effect.settle
    return [t for t in acting(terms, "tracking") if type(CATALOGUE[t.effect]).settle is not own]


def totals(terms: Iterable[Term]) -> tuple[Term, ...]:
    """Return the terms with those that add up as one of each site; totals of zero are left out.

    A stand-in is summed with what is proved, and then proved no more. A stiffness curve with a
    negative slope takes over the flexibility that it softens: only together are they 0 or more.
    """
    summed: dict[object, Term] = {}
    for number, term in enumerate(terms):
        effect = CATALOGUE[term.effect]
        key: object = (term.effect, term.site) if effect.adds_up else number
        if key in summed:
            before = summed[key]
            values = tuple(a + b for a, b in zip(before.values, term.values, strict=True))
            term = replace(term, values=values, stand_in=before.stand_in or term.stand_in)
        summed[key] = term
    for key, term in list(summed.items()):
        effect = CATALOGUE[term.effect]
        if effect.has_nonlinearity and term.values[0] < 0:
            straight = [
                k for k, other in summed.items()
                if other.effect == effect.replaces and other.site.joint == term.site.joint
            ]  # fmt: skip
            slope = term.values[0] + sum(summed.pop(k).values[0] for k in straight)
            summed[key] = replace(term, values=(max(slope, 0.0), *term.values[1:]))
    return tuple(t for t in summed.values() if not CATALOGUE[t.effect].adds_up or any(t.values))


def by_approach(terms: Iterable[Term]) -> bool:
    """Return whether terms ask for the joints' last motions."""
    return any(CATALOGUE[term.effect].depends_on_approach for term in terms)


def at_moment(terms: Iterable[Term]) -> bool:
    """Return whether a term steps once, so that it matters when a row was taken."""
    return any(CATALOGUE[term.effect].at_moment for term in terms)


def effect_named(identifier: str) -> Effect:
    """Return a member of the catalogue; raises InputError naming the nearest known one."""
    if identifier in CATALOGUE:
        return CATALOGUE[identifier]
    import difflib  # only where a name is misspelt

    near = difflib.get_close_matches(identifier, CATALOGUE, n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(CATALOGUE)}"
    raise InputError(f"found {identifier!r}, expected one of the catalogue{hint}", ("effect",))


def split_name(name: str, beside: Iterable[str] = ()) -> ParameterName | None:
    """Return the parts of a public name (``backlash``, ``backlash_5``, ``link_geometry_3_a``).

    None if it does not start with an effect's name. ``beside``: further prefixes of names.
    """
    known = (e for e in (*CATALOGUE, *beside) if f"{name}_".startswith(f"{e}_"))
    effect = max(known, key=len, default="")
    rest = r"(?:_(\d+))?(?:_order([\d.]+))?(?:_([\w.]+))?"
    match = re.fullmatch(rest, name.removeprefix(effect)) if effect else None
    if match is None:
        return None
    joint, order, part = match.groups()
    return ParameterName(effect, int(joint) if joint else None, float(order) if order else None,
                         part or "")  # fmt: skip


def names_part_of(name: str, whole: str) -> bool:
    """Return whether a parameter belongs to an effect, or to one at a joint (``backlash_5``)."""
    part, container = split_name(name), split_name(whole)
    if part is None or container is None:
        return name == whole
    return part.effect == container.effect and container.joint in (None, part.joint)


__all__ = [
    "CATALOGUE",
    "CHANNELS",
    "Effect",
    "Parameter",
    "ParameterName",
    "Reported",
    "Site",
    "Term",
    "acting",
    "at_moment",
    "by_approach",
    "correcting",
    "effect_named",
    "flexibility_effects",
    "flexibility_names",
    "names_part_of",
    "settling",
    "split_name",
    "ties_of",
    "totals",
]
