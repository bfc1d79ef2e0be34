"""The catalogue of effects: one table, by channel."""

from __future__ import annotations

import difflib

from core.effects.axial_compliance import AxialCompliance
from core.effects.backlash import Backlash
from core.effects.base_compliance import BaseCompliance
from core.effects.coulomb_friction import CoulombFriction
from core.effects.effect import CHANNELS, Effect, Parameter, Reported, Site, Term
from core.effects.ft_bias import FtBias
from core.effects.ft_drift import FtDrift
from core.effects.ft_gain import FtGain
from core.effects.ft_misalignment import FtMisalignment
from core.effects.gravity_direction import GravityDirection
from core.effects.joint_offset import JointOffset
from core.effects.latency import Latency
from core.effects.link_flexibility import LinkFlexibility
from core.effects.link_geometry import LinkGeometry
from core.effects.link_inertia import LinkInertia
from core.effects.payload import Payload
from core.effects.radial_compliance import RadialCompliance
from core.effects.rotor_inertia import RotorInertia
from core.effects.stiffness_nonlinearity import StiffnessNonlinearity
from core.effects.thermal_drift import ThermalDrift
from core.effects.tool_frame import ToolFrame
from core.effects.torque_constant import TorqueConstant
from core.effects.tracking_lag import TrackingLag
from core.effects.transmission_error import TransmissionError
from core.effects.viscous_friction import ViscousFriction
from core.errors import InputError

CATALOGUE: dict[str, Effect] = {
    effect.identifier: effect
    for effect in (
        JointOffset(),
        LinkGeometry(),
        ToolFrame(),
        TransmissionError(),
        AxialCompliance(),
        RadialCompliance(),
        LinkFlexibility(),
        StiffnessNonlinearity(),
        BaseCompliance(),
        GravityDirection(),
        Payload(),
        Backlash(),
        ThermalDrift(),
        FtBias(),
        FtDrift(),
        FtGain(),
        FtMisalignment(),
        Latency(),
        TrackingLag(),
        CoulombFriction(),
        ViscousFriction(),
        RotorInertia(),
        LinkInertia(),
        TorqueConstant(),
    )
}


def effect_named(identifier: str) -> Effect:
    """Return a member of the catalogue; raises InputError naming the nearest known one."""
    if identifier in CATALOGUE:
        return CATALOGUE[identifier]
    near = difflib.get_close_matches(identifier, CATALOGUE, n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(CATALOGUE)}"
    raise InputError(f"effect: found {identifier!r}, expected one of the catalogue{hint}")


__all__ = [
    "CATALOGUE",
    "CHANNELS",
    "Effect",
    "Parameter",
    "Reported",
    "Site",
    "Term",
    "effect_named",
]
