"""Draws cases by kind and seed.

Kinds of the position channel: ``none``; an effect (``backlash``); several (``backlash+payload``);
``pair``, ``triple``, ``four``, ``five`` (at random); ``mixed:COUNT`` or ``mixed:REMAINDER`` (known
effects and an unknown remainder); ``arm:one``, ``arm:two`` (an arm drawn at random);
``sessions:one``, ``sessions:two``; ``laid_out:clustered``, ``student``, ``doubled``;
``withheld:EFFECT``; ``outside:NAME``; ``hard:EFFECT`` and ``hard:none``; ``bad:NAME``;
``size:EFFECT@RATIO`` (at one place, gap over floor). Other channels: ``wrench:``, ``tracking:``,
``torque:`` with an effect, several, ``pair``, ``mixed``, ``none``, or one outside the catalogue.
"""

from __future__ import annotations

import zlib
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks.blind import draws, mixed_cases, special_cases
from benchmarks.blind.channel_cases import (
    EFFECTS,
    ChannelCase,
    channel_kinds,
    draw_channel_case,
    write_channel_case,
)
from benchmarks.blind.label import Label
from benchmarks.blind.measuring import read_arm
from benchmarks.blind.mechanics import Array
from benchmarks.blind.outside import OUTSIDE
from benchmarks.blind.remainders import ALONE, REMAINDERS
from benchmarks.blind.special_cases import Strange
from benchmarks.blind.static_cases import Drawn, StaticDraw, causes_of, draw_static, write_static
from benchmarks.blind.wrench_cases import WrenchCell

CHANNELS = tuple(EFFECTS)
COUNTS = {"pair": 2, "triple": 3, "four": 4, "five": 5}
MIXED = ("1", "2", "3")
LAYOUTS = {
    "laid_out": special_cases.draw_laid_out,
    "arm": special_cases.draw_arms,
    "sessions": special_cases.draw_sessions,
}


@dataclass(frozen=True)
class Static:
    """A drawn case of the position channel, before it is measured."""

    drawn: Drawn
    strange: Strange | None
    gap: Array  # whitened and noise-free, the frame not taken out
    outliers: bool


def generator_of(kind: str, seed: int) -> Generator:
    """Return the random generator of a case; a withheld case has the data of the plain one."""
    return np.random.default_rng([seed, zlib.crc32(kind.removeprefix("withheld:").encode())])


@lru_cache(maxsize=2)
def drawn_case(kind: str, seed: int) -> tuple[Static | ChannelCase, Generator]:
    """Return a case's truth, and the generator as it stands after the draw; do not move it."""
    rng = generator_of(kind, seed)
    return draw_case(kind, rng), rng


def effects_of(kind: str, rng: Generator) -> tuple[str, ...]:
    """Return the effects that a kind puts into the position channel."""
    if kind == "none":
        return ()
    if kind in COUNTS:
        return draws.some_effects(COUNTS[kind], rng)
    effects = tuple(kind.split("+"))
    for effect in effects:
        if effect not in draws.POSITION_EFFECTS:
            raise ValueError(f"kind: found {effect!r}, expected an effect of the position channel")
    if set(effects) >= draws.ONE_OF:
        raise ValueError(
            f"kind: found {kind!r}, expected one of {' and '.join(sorted(draws.ONE_OF))}"
        )
    return effects


def draw_case(kind: str, rng: Generator) -> Static | ChannelCase:
    """Return the truth of a case, before it is measured."""
    group, _, rest = kind.removeprefix("withheld:").rpartition(":")
    if group in CHANNELS:
        return draw_channel_case(group, rest, rng)
    if group == "outside":
        strange = special_cases.draw_outside(rest, rng)
        return Static(strange.drawn, strange, strange.gap, outliers=False)
    if group == "mixed":
        strange = _draw_mixed(rest, rng)
        return Static(strange.drawn, strange, strange.gap, outliers=False)
    if group == "bad":
        drawn = special_cases.draw_bad(rest, rng)
    elif group in LAYOUTS:
        drawn = LAYOUTS[group](rest, rng)
    elif group == "hard":
        drawn = special_cases.draw_hard(effects_of(rest, rng), rng)
    elif group == "":
        drawn = draw_static(StaticDraw(effects_of(rest, rng)), rng)
    elif group == "size":
        effect, _, ratio = rest.partition("@")
        asked = StaticDraw(effects_of(effect, rng), ratio=float(ratio), clear=False)
        drawn = draw_static(asked, rng)
    else:
        raise ValueError(f"kind: found {kind!r}, expected one of those that --list shows")
    return Static(drawn, None, drawn.bench.whitened_gap(drawn.real), outliers=group == "hard")


def _draw_mixed(what: str, rng: Generator) -> Strange:
    if what in MIXED:
        return mixed_cases.draw_mixed(int(what), None, rng)
    if what not in REMAINDERS:
        known = ", ".join((*MIXED, *REMAINDERS))
        raise ValueError(f"kind: found mixed:{what}, expected one of {known}")
    return mixed_cases.draw_mixed(int(rng.integers(1, 4)), what, rng)


def make_case(kind: str, seed: int, folder: Path) -> Label:
    """Write the case's log.csv and cell.yaml into ``folder``; return its truth.

    Nothing of the label is written there. Raises ValueError where the kind is unknown.
    """
    case, at = drawn_case(kind, seed)
    rng = deepcopy(at)
    if isinstance(case, ChannelCase):
        write_channel_case(Path(folder), case, rng)
        return _channel_label(kind, seed, case)
    drawn, bench = case.drawn, case.drawn.bench
    if case.outliers:
        measured = special_cases.with_outliers(drawn, rng)
    else:
        misread = case.strange.misread if case.strange else None
        measured = read_arm(drawn.real, bench.session, bench.instrument, rng, misread)
    facts = write_static(Path(folder), drawn, rng, measured)
    if bench.fresh is not None:
        facts["beyond"] = len(bench.fresh.q)
    causes = causes_of(drawn.parts)
    outside = case.strange.outside if case.strange else None
    return Label(
        kind=kind,
        seed=seed,
        arm=bench.kind.name,
        channel="position",
        causes=causes,
        floor_rms=bench.floor,
        gap_rms=drawn.shown_rms(case.gap),
        depends_on=outside.depends_on if outside else (),
        outside=outside.name if outside else None,
        akin=outside.akin if outside else (),
        withhold=tuple(c.effect for c in causes) if kind.startswith("withheld:") else (),
        facts=facts,
    )


def _channel_label(kind: str, seed: int, case: ChannelCase) -> Label:
    causes = case.truth.causes(case.values)
    facts: dict[str, str | float | bool] = {"rows": len(case.gap) / len(case.truth.sigma)}
    if isinstance(case.cell, WrenchCell):
        drifts = any(c.effect == "ft_drift" for c in causes)
        facts["settling_drift"] = case.cell.saturating and drifts
    return Label(
        kind=kind,
        seed=seed,
        arm=case.bench.kind.name,
        channel=case.channel,
        causes=causes,
        floor_rms=case.floor_rms,
        gap_rms=float(np.sqrt(np.mean(case.gap**2))) * case.floor_rms,
        depends_on=case.depends_on,
        outside=case.outside,
        akin=case.akin,
        withhold=tuple(c.effect for c in causes) if kind.startswith("withheld:") else (),
        facts=facts,
    )


def kinds() -> dict[str, tuple[str, ...]]:
    """Return all kinds by group."""
    position, others = position_kinds(), channel_kinds()
    return {group: own + others.get(group, ()) for group, own in position.items()}


def group_of(kind: str) -> str:
    """Return the group that a kind is scored in; also of kinds made up on the command line."""
    for group, own in kinds().items():
        if kind in own:
            return group
    head = kind.partition(":")[0]
    if head in ("withheld", "outside", "hard", "bad", "size", "mixed", *LAYOUTS):
        return head
    return "several" if "+" in kind else "known"


def position_kinds() -> dict[str, tuple[str, ...]]:
    """Return the kinds of the position channel by group."""
    known = draws.POSITION_EFFECTS
    return {
        "clean": ("none",),
        "known": known,
        "several": ("pair", "triple"),
        "many": ("four", "five"),
        "mixed": tuple(f"mixed:{c}" for c in MIXED),
        "arm": tuple(f"arm:{c}" for c in special_cases.ONE_OR_TWO),
        "sessions": tuple(f"sessions:{c}" for c in special_cases.ONE_OR_TWO),
        "laid_out": tuple(f"laid_out:{n}" for n in special_cases.LAID_OUT),
        "withheld": tuple(f"withheld:{e}" for e in known),
        "outside": tuple(f"outside:{n}" for n in (*OUTSIDE, *ALONE)),
        "hard": tuple(f"hard:{e}" for e in (*known, "none")),
        "bad": tuple(f"bad:{n}" for n in special_cases.BAD),
    }
