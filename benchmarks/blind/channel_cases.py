"""Draws and writes cases of the wrench, tracking and torque channels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks.blind import moving_cases as moving
from benchmarks.blind import wrench_cases as wrench
from benchmarks.blind.bench import Bench
from benchmarks.blind.draws import Redraw
from benchmarks.blind.measuring import without
from benchmarks.blind.mechanics import Array
from benchmarks.blind.parametric import CLEAR, Parametric, Place, Values, draw_values
from benchmarks.blind.session import Plan
from benchmarks.blind.writing import write_cell, write_log

EFFECTS = {"wrench": wrench.EFFECTS, "tracking": moving.TRACKING, "torque": moving.TORQUE}
OUTSIDE = {
    "wrench": wrench.OUTSIDE,
    "tracking": moving.TRACKING_OUTSIDE,
    "torque": moving.TORQUE_OUTSIDE,
}
# remainders of mixed cases: none that an effect of the catalogue could be
REMAINDERS = {
    "wrench": (*wrench.OUTSIDE, *wrench.REMAINDERS),
    "tracking": ("track_step", "speed_loss", *moving.TRACKING_REMAINDERS),
    "torque": ("cogging", "warm_friction", *moving.TORQUE_REMAINDERS),
}
# what a remainder holds at first order: effects, of the whole cell or of the joint itself
AKIN: dict[str, tuple[tuple[str, bool], ...]] = {
    "ft_hose": (("ft_bias", True),), "ft_field": (("ft_bias", True),),
    "ft_step": (("ft_bias", True), ("ft_drift", True)), "ft_overload": (("ft_bias", True),),
    "speed_loss": (("latency", False), ("tracking_lag", False)),
    "warm_friction": (("viscous_friction", False), ("coulomb_friction", False)),
    "torque_field": (("torque_offset", False),),
}  # fmt: skip
COUPLED = ("link_inertia",)  # effects of one joint that other joints feel
SIZE = (0.5, 1.5)  # a remainder over a known effect
SHOWN = 36.0  # chi-square of a known effect, the remainder counted as noise
UNLIKE = 100.0  # chi-square that known effects and any one more must leave of a remainder
RATIOS = {"wrench": (3.0, 15.0), "tracking": (60.0, 1000.0), "torque": (0.7, 6.0)}
NONNEGATIVE = (
    "latency", "tracking_lag", "coulomb_friction", "viscous_friction", "rotor_inertia", "payload",
    "link_inertia", "servo_droop", "dead_band", "stribeck_friction", "load_friction",
)  # fmt: skip


@dataclass(frozen=True)
class ChannelCase:
    """A drawn case of one channel."""

    channel: str
    cell: wrench.WrenchCell | moving.MovingCell
    values: Values
    error: Array | None  # (N, k) outside the catalogue
    outside: str | None
    depends_on: tuple[str, ...]
    akin: tuple[Place, ...] = ()  # what the unknown holds at first order

    @property
    def bench(self) -> Bench:
        """Return the cell's arm and declared loads."""
        return self.cell.bench

    @property
    def truth(self) -> Parametric:
        """Return the truth of the channel."""
        return self.cell.truth

    @property
    def gap(self) -> Array:
        """Return the noise-free gap in units of the noise, flat."""
        gap = self.truth.gap(self.values)
        return gap if self.error is None else gap + (self.error / self.truth.sigma).ravel()

    @property
    def known_gap(self) -> Array:
        """Return the gap to explain: of a mixed case that of its known effects alone."""
        return self.truth.gap(self.values) if self.values else self.gap

    @property
    def floor_rms(self) -> float:
        """Return the noise per coordinate in the channel's unit; of a wrench, its forces."""
        sigma = self.truth.sigma[:3] if self.channel == "wrench" else self.truth.sigma
        return float(np.sqrt(np.mean(sigma**2)))


DRAWS = 600  # a delay and a lag are hardly separable in most slow motions


def draw_channel_case(channel: str, what: str, rng: Generator) -> ChannelCase:
    """Return a case: ``what`` is none, effects joined by +, pair, mixed, or a name outside."""
    if what == "mixed":
        return _draw_mixed(channel, rng)
    effects: tuple[str, ...] = ()
    strange = what if what in (*OUTSIDE[channel], *REMAINDERS[channel]) else None
    if what == "pair":
        effects = tuple(str(e) for e in rng.choice(EFFECTS[channel], 2, replace=False))
    elif strange is None and what != "none":
        effects = tuple(what.split("+"))
        for effect in effects:
            if effect not in EFFECTS[channel]:
                known = ", ".join((*EFFECTS[channel], *OUTSIDE[channel]))
                raise ValueError(f"kind: found {effect!r} in {channel}, expected one of {known}")
    for _ in range(DRAWS):
        cell = _draw_cell(channel, rng)
        try:
            values = draw_values(
                cell.truth, effects, rng, RATIOS[channel], lambda e: e not in NONNEGATIVE
            )
        except Redraw:
            continue
        error, columns = _error(cell, strange, rng) if strange else (None, ())
        return ChannelCase(channel, cell, values, error, strange, columns)
    raise RuntimeError(f"no clear draw of {channel}:{what} in {DRAWS}")


def _draw_mixed(channel: str, rng: Generator) -> ChannelCase:
    """Return one to three known effects beside a remainder, half to one and a half as large."""
    for _ in range(DRAWS):
        most = min(3, len(EFFECTS[channel]) - 1)
        count = int(rng.integers(1, most + 1)) if most > 1 else 1
        effects = tuple(str(e) for e in rng.choice(EFFECTS[channel], count, replace=False))
        name = str(rng.choice(REMAINDERS[channel]))
        cell = _draw_cell(channel, rng)
        try:
            values = draw_values(
                cell.truth, effects, rng, RATIOS[channel], lambda e: e not in NONNEGATIVE
            )
        except Redraw:
            continue
        error, columns = _error(cell, name, rng)
        each = [
            float(np.mean(cell.truth.gap({p: v for p, v in values.items() if p[0] == e}) ** 2))
            for e in dict.fromkeys(p[0] for p in values)
        ]
        usual = float(np.exp(np.mean(np.log(each))))
        size = np.sqrt(usual / np.mean((error / cell.truth.sigma) ** 2))
        error = error * size * rng.uniform(*SIZE)
        akin = _akin(name, columns)
        if {p for p in values if p in akin} or not _separable(cell.truth, values, error):
            continue
        return ChannelCase(channel, cell, values, error, name, columns, akin)
    raise RuntimeError(f"no clear draw of {channel}:mixed in {DRAWS}")


def _akin(name: str, columns: tuple[str, ...]) -> tuple[Place, ...]:
    """Return the places of a remainder's first order; its own joint is the first column's."""
    joints = [int(c.rpartition("_")[2]) + 1 for c in columns if c != "timestamp" and "_" in c
              and c.rpartition("_")[2].isdigit()]  # fmt: skip
    return tuple((effect, None if whole else joints[0]) for effect, whole in AKIN.get(name, ()))


def _separable(truth: Parametric, values: Values, error: Array) -> bool:
    """Return whether each known place shows beside the remainder, and it beside any place more."""
    unknown = (error / truth.sigma).ravel()
    full = truth.gap(values)
    for place in values:
        rest = {p: v for p, v in values.items() if p != place}
        columns = np.column_stack([truth.columns(rest, values), unknown])
        left = without(columns, full - truth.gap(rest))
        if float(left @ left) < max(CLEAR, SHOWN * (1 + float(np.mean(unknown**2)))):
            return False
    own = truth.columns(values, values)
    touched = {int(j) + 1 for j in np.flatnonzero(np.any(error, axis=0))}
    for place in truth.candidates:
        if place[0] not in COUPLED and place[1] is not None and place[1] not in touched:
            continue  # at another joint alone, it makes nothing of this
        columns = own if place in values else np.hstack([own, truth.columns([place], values)])
        left = without(columns, unknown)
        if float(left @ left) < UNLIKE:
            return False
    return True


def _draw_cell(channel: str, rng: Generator) -> wrench.WrenchCell | moving.MovingCell:
    if channel == "wrench":
        plan = Plan(poses=60, blocks=int(rng.integers(2, 5)), pulled=float(rng.uniform(0, 0.3)))
        return wrench.draw_wrench_cell(rng, plan)
    return moving.draw_tracking_cell(rng) if channel == "tracking" else moving.draw_torque_cell(rng)


def _error(
    cell: wrench.WrenchCell | moving.MovingCell, name: str, rng: Generator
) -> tuple[Array, tuple[str, ...]]:
    if isinstance(cell, wrench.WrenchCell):
        return wrench.outside_error(cell, name, rng)
    if name in (*moving.TRACKING_OUTSIDE, *moving.TRACKING_REMAINDERS):
        return moving.tracking_error(cell, name, rng)
    return moving.torque_error(cell, name, rng)


def write_channel_case(folder: Path, case: ChannelCase, rng: Generator) -> None:
    """Write log.csv and cell.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = _static_columns(case, rng) if case.channel == "wrench" else _moving(case, rng)
    write_log(folder / "log.csv", columns)
    bench = case.bench
    load = (float(bench.session.payload_mass[0]), bench.session.payload_cog[0])
    write_cell(folder, bench.kind, bench.nominal, load, None)


def _static_columns(case: ChannelCase, rng: Generator) -> dict[str, Array]:
    session = case.bench.session
    reading = case.truth.noisy(case.values, rng)
    if case.error is not None:
        reading = reading + case.error
    return {
        "timestamp": session.time,
        "actual_q": session.q,
        "payload": session.payload_mass,
        "payload_cog": session.payload_cog,
        "actual_TCP_force": session.tcp_wrench,
        "joint_temperatures": session.temperature,
        "ft_raw_wrench": reading,
    }


def _moving(case: ChannelCase, rng: Generator) -> dict[str, Array]:
    cell = case.cell
    assert isinstance(cell, moving.MovingCell)
    commanded = cell.motion.at(cell.time)
    qd = cell.motion.at(cell.time, 1)
    columns = {"timestamp": cell.time}
    if case.channel == "tracking":
        actual = cell.truth.read(case.values)
        actual = actual if case.error is None else actual + case.error
        columns |= {"target_q": commanded, "actual_q": cell.encoded(actual, rng)}
        if rng.random() < 0.6:
            columns["actual_qd"] = qd + rng.normal(0, 1e-3, qd.shape)
        return columns
    torque = cell.truth.noisy(case.values, rng)
    columns |= {
        "actual_q": cell.encoded(commanded, rng),
        "actual_qd": qd + rng.normal(0, 5e-4, qd.shape),
        "actual_current_as_torque": torque if case.error is None else torque + case.error,
    }
    if rng.random() < 0.5 or np.ptp(cell.payload) > 0:
        columns["payload"] = cell.payload
        columns["payload_cog"] = np.tile(cell.bench.session.payload_cog[0], (len(cell.time), 1))
    return columns


def channel_kinds() -> dict[str, tuple[str, ...]]:
    """Return the kinds of these channels by group."""
    known = tuple(f"{c}:{e}" for c, own in EFFECTS.items() for e in own)
    return {
        "clean": tuple(f"{c}:none" for c in EFFECTS),
        "known": known,
        "several": tuple(f"{c}:pair" for c in EFFECTS),
        "mixed": tuple(f"{c}:mixed" for c in EFFECTS),
        "withheld": tuple(f"withheld:{k}" for k in known),
        "outside": tuple(
            f"{c}:{n}" for c in OUTSIDE for n in dict.fromkeys((*OUTSIDE[c], *REMAINDERS[c]))
        ),
    }
