"""What looks alike: effects that others can stand for on poor data, and what the diagnosis says.

``python -m benchmarks.blind.ties``. A truth with one effect at one place is drawn, on data that
excite everything and on poor ones. Which other effects, at one place or free at all of theirs,
leave less than a hundredth of its gap, the truth generator's own derivatives say. Where one place
does, the diagnosis has to report a tie or to name nothing; else the effect that is there.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.random import Generator
from rich.console import Console
from rich.table import Table

from benchmarks.blind import ingredients as put
from benchmarks.blind.arms import ArmKind
from benchmarks.blind.bench import combined, draw_bench, size
from benchmarks.blind.channel_cases import ChannelCase, write_channel_case
from benchmarks.blind.draws import Redraw
from benchmarks.blind.measuring import read_arm, without
from benchmarks.blind.mechanics import Array, stand
from benchmarks.blind.moving import Motion, draw_motion
from benchmarks.blind.moving_cases import (
    Move,
    MovingCell,
    draw_torque_cell,
    draw_tracking_cell,
    draw_tracking_motion,
)
from benchmarks.blind.parametric import Parametric, Place
from benchmarks.blind.run import Command
from benchmarks.blind.session import Plan
from benchmarks.blind.static_cases import Drawn, draw_plan, write_static
from benchmarks.blind.twins import SAME, left_over, singles
from benchmarks.blind.wrench_cases import WrenchCell, draw_wrench_cell

ALIKE = 0.01  # share of a gap that another effect leaves of it where they look alike
RATIO = {"torque": 4.0, "tracking": 20.0, "position": 10.0, "wrench": 10.0}  # of gap over floor
DRAWS = 200
SLOW = (3.0, 5.0)  # where Stribeck's curve falls, over the largest speed


@dataclass(frozen=True)
class Steady(Motion):
    """All joints one way at one speed each; amplitude times rate is the speed."""

    def at(self, time: Array, derivative: int = 0) -> Array:
        """Return q (N, n) at times (N,) or (N, n), or its derivative."""
        t = time[:, None] if time.ndim == 1 else time
        speed = (self.amplitude * self.rate)[:, 0]
        path = self.centre + speed * t if derivative == 0 else speed * (derivative == 1)
        return np.broadcast_to(path, np.broadcast_shapes(np.shape(path), t.shape)).copy()

    def lagged(self, time: Array, delay: Array, lag: Array) -> Array:
        """Return q (N, n) behind a pure delay and a first-order lag per joint (s), settled."""
        return self.at(time[:, None] - delay - lag)


def steady(kind: ArmKind, rng: Generator) -> Motion:
    """Return half a minute of each joint at one speed, one way."""
    motion = draw_motion(kind, rng, terms=1)
    speed = rng.uniform(0.02, 0.05, (kind.n, 1)) * rng.choice([-1.0, 1.0], (kind.n, 1))
    return Steady(motion.centre - 15.0 * speed[:, 0], speed, np.ones_like(speed), motion.phase)


def small(kind: ArmKind, rng: Generator) -> Motion:
    """Return a motion about one pose, so small that no weight changes."""
    motion = draw_motion(kind, rng)
    return replace(motion, amplitude=1e-3 * motion.amplitude)


def one_way(kind: ArmKind, rng: Generator) -> Motion:
    """Return a slow motion of each joint one way, by up to half a radian."""
    motion = draw_motion(kind, rng, terms=1)
    way = rng.choice([-1.0, 1.0], motion.rate.shape)
    rate = np.full_like(way, 0.06)
    return replace(motion, amplitude=0.3 * way, rate=rate, phase=np.full_like(way, -0.9))


def hardly(kind: ArmKind, rng: Generator) -> Motion:
    """Return a slow motion one way in which weights hardly change."""
    motion = one_way(kind, rng)
    return replace(motion, amplitude=0.1 * motion.amplitude)


@dataclass(frozen=True)
class Data:
    """An effect and data of it: what they lack, what it looks like there, and how to draw them."""

    effect: str
    channel: str
    lack: str  # '': they excite everything
    alike: tuple[str, ...] = ()  # at one place each
    move: Move | None = None
    knee: tuple[float, float] = (0.04, 0.15)
    loads: int = 1
    plan: Plan | None = None  # of a session with a flange sensor


def _whole(effect: str, channel: str) -> Data:
    move = draw_tracking_motion if channel == "tracking" else draw_motion
    return Data(effect, channel, "", (), move)


UPRIGHT = Plan(poses=60, blocks=1, pulled=0.0, moving=(0,))  # joint 1 turns about gravity
TURNED = Plan(poses=60, blocks=3, pulled=0.2)

TABLE = (
    Data("joint_slip", "position", ""),
    Data("joint_slip", "position", "no joint beyond it moves after the moment", ("target_slip",)),
    Data("target_slip", "position", ""),
    _whole("servo_droop", "tracking"),
    Data("servo_droop", "tracking", "one torque at each joint, reached from one side",
         ("dead_band",), hardly),
    _whole("dead_band", "tracking"),
    Data("dead_band", "tracking", "motion one way at one speed", ("latency", "tracking_lag"),
         steady),
    _whole("viscous_friction", "torque"),
    Data("viscous_friction", "torque", "motion one way at one speed",
         ("coulomb_friction", "torque_offset"), steady),
    _whole("stribeck_friction", "torque"),
    Data("stribeck_friction", "torque", "motion one way at one speed",
         ("coulomb_friction", "torque_offset"), steady, SLOW),
    _whole("load_friction", "torque"),
    Data("load_friction", "torque", "motion under one load", ("coulomb_friction",), small),
    _whole("torque_offset", "torque"),
    Data("torque_offset", "torque", "motion of the joint one way only", ("coulomb_friction",),
         one_way),
    Data("torque_offset", "torque", "a joint whose weight never changes", ("link_cog",), small),
    _whole("link_cog", "torque"),
    Data("link_cog", "torque", "poses at which the link pulls in one direction",
         ("link_inertia",), small),
    _whole("torque_constant", "torque"),
    Data("torque_constant", "torque", "motion in which the joint's torque never changes",
         ("torque_offset",), small),
    Data("payload_cog", "torque", "", (), draw_motion, loads=2),
    Data("payload_cog", "torque", "one constant load", ("link_cog",), draw_motion),
    Data("payload_cog", "wrench", "", plan=TURNED),
    Data("payload_cog", "wrench", "one load, and a flange that never turns against gravity",
         ("ft_bias",), plan=UPRIGHT),
    Data("payload", "wrench", "", plan=TURNED),
    Data("payload", "wrench", "a flange that never turns against gravity", ("ft_bias",),
         plan=UPRIGHT),
)  # fmt: skip


@dataclass(frozen=True)
class Shown:
    """A truth with one effect, and which others can make its gap."""

    gap: float  # chi-square, noise-free
    left: dict[str, float]  # share of the gap that another effect leaves at its best place
    free: dict[str, float]  # the same, free at all its places
    write: Callable[[Path], None]

    @property
    def same(self) -> set[str]:
        """Return the effects that do as well at one place."""
        return {name for name, share in self.left.items() if share < ALIKE}

    @property
    def sure(self) -> bool:
        """Return whether the data, with their noise, tell the effect from those all the same."""
        return all(self.left[name] * self.gap > SAME for name in self.same)

    @property
    def possible(self) -> set[str]:
        """Return the effects that do as well at some places."""
        return {name for name, share in self.free.items() if share < ALIKE} | self.same


def draw(data: Data, rng: Generator) -> Shown:
    """Return a truth with the effect at one place, on data where it looks as it should.

    Raises RuntimeError where it never does.
    """
    for _ in range(DRAWS):
        try:
            shown = (_static if data.channel == "position" else _parametric)(data, rng)
        except Redraw:
            continue
        if set(data.alike) <= shown.same and (data.lack or not shown.same):
            return shown
    raise RuntimeError(f"{data.effect}, {data.lack or 'excited'}: not in {DRAWS} draws")


def _cell(data: Data, rng: Generator) -> WrenchCell | MovingCell:
    if data.plan is not None:
        return draw_wrench_cell(rng, data.plan)
    assert data.move is not None
    if data.channel == "tracking":
        return draw_tracking_cell(rng, move=data.move)
    return draw_torque_cell(rng, move=data.move, knee=data.knee, loads=data.loads)


def _parametric(data: Data, rng: Generator) -> Shown:
    cell = _cell(data, rng)
    truth = cell.truth
    places = [p for p in truth.candidates if p[0] == data.effect]
    place = places[int(rng.integers(len(places)))]
    value = truth.size(place, truth.candidates[place].scale, RATIO[data.channel])
    case = ChannelCase(data.channel, cell, {place: value}, None, None, ())

    def write(folder: Path) -> None:
        write_channel_case(folder, case, rng)

    left, free = _others(truth, case.gap, data.effect)
    return Shown(float(case.gap @ case.gap), left, free, write)


def _others(
    truth: Parametric, gap: Array, effect: str
) -> tuple[dict[str, float], dict[str, float]]:
    """Return what each other effect leaves of a gap, at its best place and at all of them."""
    whole, single, free = float(gap @ gap), {}, {}

    def left(places: Iterable[Place]) -> float:
        rest = without(truth.columns(places, {}), gap)
        return float(rest @ rest) / whole

    for name in dict.fromkeys(p[0] for p in truth.candidates):
        places = [p for p in truth.candidates if p[0] == name]
        if name != effect:
            single[name] = min(left([p]) for p in places)
            free[name] = left(places)
    return single, free


def _static(data: Data, rng: Generator) -> Shown:
    """Return a session with a slip half-way, joint 6 at rest from then on where data lack it."""
    bench = draw_bench(rng, draw_plan(rng), arm="cobot10", compliant=False, with_rotation=False)
    session, moment = bench.session, float(np.median(bench.session.time))
    joint = int(rng.integers(2, 6))
    if data.lack:
        joint, q = 5, session.q.copy()
        q[session.time >= moment, 5] = q[-1, 5]
        session = replace(session, q=q)
        bench = replace(bench, session=session, model=stand(bench.nominal, session))
    if data.effect == "joint_slip":
        part = put.joint_slip(joint, 1e-3, moment)
    else:
        part = put.target_slip(rng.normal(size=3) * 1e-3, moment)
    part = size(bench, part, RATIO["position"])
    drawn = Drawn(bench, (part,), combined(bench, [part]))
    gap = bench.whitened_gap(drawn.real)
    shown = without(bench.frame(), gap)
    left: dict[str, float] = {}
    others = [
        ("target_slip", None, (moment,)),
        *(("joint_slip", j, (moment,)) for j in range(1, 7)),
    ]
    for other in [*singles(bench), *others]:
        if other[0] != data.effect:
            own = left_over(bench, gap, [other]) / float(shown @ shown)
            left[other[0]] = min(own, left.get(other[0], own))

    def write(folder: Path) -> None:
        measured = read_arm(drawn.real, session, bench.instrument, rng, None)
        write_static(folder, drawn, rng, measured)

    return Shown(float(shown @ shown), left, {}, write)


def answer(document: dict[str, Any], data: Data) -> tuple[set[str], bool]:
    """Return the effects that a diagnosis names, and whether it calls one of them a tie."""
    causes = [c for channel in document["channels"] if channel["channel"] == data.channel
              for c in channel["causes"]]  # fmt: skip
    return {c["effect"] for c in causes}, any(c["indistinguishable_from"] for c in causes)


def right(data: Data, shown: Shown, named: set[str], tie: bool) -> bool:
    """Return whether these data let anybody say so."""
    if shown.sure and named == {data.effect}:
        return True
    if shown.same:
        return not named or (tie and named <= {data.effect, *shown.possible})
    return len(named) == 1 and named <= shown.possible


@click.command()
@click.option("--seeds", default=3, show_default=True, help="Cases of each row.")
@click.option("--seed", default=1, show_default=True, help="First seed.")
@click.option("--only", default=None, help="Effects, by commas.")
@click.option("--command", default="gapbridge diagnose", show_default=True)
def main(seeds: int, seed: int, only: str | None, command: str) -> None:
    """Show which effects look alike on which data, and what the diagnosis says there."""
    diagnose, wanted = Command.parse(command), only.split(",") if only else None
    table = Table("effect", "data", "looks like", "answers", "right")
    wrong = 0
    for row, data in enumerate(TABLE):
        if wanted and data.effect not in wanted:
            continue
        answers, same, good = [], set(), 0
        for k in range(seeds):
            rng = np.random.default_rng([seed + k, row])
            shown = draw(data, rng)
            with tempfile.TemporaryDirectory(prefix="tie-") as folder:
                shown.write(Path(folder))
                found = diagnose(Path(folder) / "log.csv", Path(folder) / "cell.yaml", ())
            named, tie = answer(found, data)
            same |= shown.same
            good += right(data, shown, named, tie)
            answers.append((", ".join(sorted(named)) or "nothing") + (" as a tie" if tie else ""))
            print(data.effect, data.lack, sorted(shown.same), sorted(shown.possible), answers[-1],
                  file=sys.stderr, flush=True)  # fmt: skip
        wrong += seeds - good
        counted = "; ".join(f"{answers.count(a)} {a}" for a in dict.fromkeys(answers))
        lack = data.lack or "everything excited"
        table.add_row(data.effect, lack, ", ".join(sorted(same)), counted, f"{good} of {seeds}")
    console = Console()
    if not console.is_terminal:
        console.width = 190
    console.print(table)
    sys.exit(int(wrong > 0))


if __name__ == "__main__":
    main()
