"""The twin experiment: can other effects than the true ones make the very same data.

Answered with the truth generator's own derivatives, never with the diagnosis: a hypothesis
(effects and joints) is fitted to the noise-free gap, the unknown tracker frame along with it; what
it leaves, in units of the noise, is the non-centrality that any test has for separating the two.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from benchmarks.blind import draws
from benchmarks.blind import ingredients as put
from benchmarks.blind.bench import Bench
from benchmarks.blind.ingredients import Ingredient
from benchmarks.blind.measuring import axial_moments, without
from benchmarks.blind.mechanics import Array, RealArm

SAME = 20.0  # chi-square below which no fair test separates two hypotheses 98 times in 100
# effect, joint, orders of its lines; of a slip its moments, s
Hypothesis = tuple[str, int | None, tuple[float, ...]]
SLIPS = ("joint_slip", "target_slip")


def probes(
    bench: Bench, effect: str, joint: int | None, orders: Iterable[float]
) -> list[Ingredient]:
    """Return small ingredients whose gaps span what an effect at a place can do."""
    kind = bench.kind
    if effect == "tool_frame":
        count = 3 if bench.instrument.sigma_turn is None else 6
        return [put.tool_frame(e[:3] * 1e-4, e[3:] * 1e-4) for e in np.eye(6)[:count]]
    if effect == "base_compliance":
        soft = kind.radial[0]
        return [put.base_compliance(soft, 0, 1.0), put.base_compliance(0, soft, 1.0)]
    if effect == "gravity_direction":
        return [put.gravity_direction(1e-3, 0), put.gravity_direction(0, 1e-3)]
    if effect == "payload":
        return [put.payload(0.01 * kind.rated, kind.rated)]
    if effect == "thermal_drift":
        return [put.thermal_drift(1e-6)]
    if effect == "payload_cog":
        return [put.payload_cog(e * 1e-3, 1.0) for e in np.eye(3)]
    if effect == "target_slip":
        return [put.target_slip(e * 1e-4, moment) for moment in orders for e in np.eye(3)]
    if joint is None:
        raise ValueError(f"{effect} needs a joint")
    return _joint_probes(bench, effect, joint, orders)


def _joint_probes(
    bench: Bench, effect: str, joint: int, orders: Iterable[float]
) -> list[Ingredient]:
    kind = bench.kind
    soft, base_rotation = kind.axial[joint - 1] / 10, kind.radial[joint - 1] / 10
    if effect == "joint_offset":
        return [put.joint_offset(joint, 1e-5)]
    if effect == "link_geometry":
        parallel = abs(np.sin(kind.rows[joint - 1].alpha)) < 1e-6
        keys = ["a", "d", "alpha"] + (["beta"] if parallel else [])
        return [put.link_geometry(joint, {k: 1e-5}) for k in keys]
    if effect == "transmission_error":
        return [
            put.transmission_error(joint, o, 1e-5, phase)
            for o in orders
            for phase in (0, np.pi / 2)
        ]
    if effect == "axial_compliance":
        return [put.axial_compliance(joint, soft, 1.0)]
    if effect == "radial_compliance":
        return [put.radial_compliance(joint, base_rotation, 1.0)]
    if effect == "link_flexibility":
        return [put.link_flexibility(joint, soft, 1.0)]
    if effect == "stiffness_nonlinearity":
        usual = float(np.abs(axial_moments(bench.nominal, bench.session)[:, joint - 1]).max())
        knees = np.array([0.15, 0.3, 0.6, 1.2, 10.0]) * max(usual, 1e-6)
        return [put.stiffness_nonlinearity(joint, soft, k, 1.0) for k in knees]
    if effect == "joint_slip":
        return [put.joint_slip(joint, 1e-5, moment) for moment in orders]
    if effect == "backlash":
        return [put.backlash(joint, 1e-5)]
    raise ValueError(f"effect: found {effect!r}, expected one of the position channel")


def columns_of(bench: Bench, hypotheses: Iterable[Hypothesis], around: RealArm) -> Array:
    """Return the whitened directions (m, k) in which hypotheses move the gap, around an arm."""
    at = bench.whitened_gap(around)
    columns = [
        bench.whitened_gap(probe.apply(around)) - at
        for effect, joint, orders in hypotheses
        for probe in probes(bench, effect, joint, orders)
    ]
    return np.column_stack(columns) if columns else np.zeros((len(at), 0))


def left_over(
    bench: Bench, real_gap: Array, hypotheses: Iterable[Hypothesis], around: RealArm | None = None
) -> float:
    """Return the chi-square that hypotheses leave of a noise-free, whitened gap.

    ``around`` is an arm that has what of the truth the hypotheses share: large effects are not
    linear together.
    """
    arm = around or bench.nominal
    columns = columns_of(bench, hypotheses, arm)
    left = without(np.column_stack([bench.frame(), columns]), real_gap - bench.whitened_gap(arm))
    return float(left @ left)


def singles(bench: Bench, in_time: bool = True) -> list[Hypothesis]:
    """Return every effect at every place, periodic ones with one and two cycles a turn.

    A slip stands there at each of eight moments, where the gap may go by time at all.
    """
    soft = bool(np.any(bench.nominal.axial))
    out: list[Hypothesis] = []
    for effect in draws.POSITION_EFFECTS:
        if effect in draws.NEEDS_COMPLIANCE and not soft:
            continue
        if effect in SLIPS and not in_time:
            continue
        if effect in SLIPS:
            places = draws.sites(effect, bench.kind) if effect in draws.PER_JOINT else [None]
            moments = np.quantile(bench.session.time, np.linspace(0.15, 0.85, 8))
            out += [(effect, j, (float(t),)) for j in places for t in moments]
        elif effect in draws.PER_JOINT:
            out += [(effect, j, (1.0, 2.0)) for j in draws.sites(effect, bench.kind)]
        else:
            out.append((effect, None, ()))
    return out
