"""Draws cases by kind and seed.

Kinds: ``none``; an effect of the position channel (``backlash``); several (``backlash+payload``);
``pair``, ``triple`` (at random); ``withheld:EFFECT``; ``hard:EFFECT``.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks.blind import draws
from benchmarks.blind.label import Label
from benchmarks.blind.static_cases import causes_of, draw_static, write_static


def generator_of(kind: str, seed: int) -> Generator:
    """Return the random generator of a case; a withheld case has the data of the plain one."""
    return np.random.default_rng([seed, zlib.crc32(kind.removeprefix("withheld:").encode())])


def effects_of(kind: str, rng: Generator) -> tuple[str, ...]:
    """Return the effects that a kind puts into the position channel."""
    if kind == "none":
        return ()
    if kind in ("pair", "triple"):
        count = 2 if kind == "pair" else 3
        return tuple(str(e) for e in rng.choice(draws.POSITION_EFFECTS, count, replace=False))
    effects = tuple(kind.split("+"))
    for effect in effects:
        if effect not in draws.POSITION_EFFECTS:
            raise ValueError(f"kind: found {effect!r}, expected an effect of the position channel")
    return effects


def make_case(kind: str, seed: int, folder: Path) -> Label:
    """Write the case's log.csv and cell.yaml into ``folder``; return its truth."""
    rng = generator_of(kind, seed)
    plain = kind.removeprefix("withheld:")
    effects = effects_of(plain, rng)
    drawn = draw_static(effects, rng)
    facts = write_static(Path(folder), drawn, rng)
    return Label(
        kind=kind,
        seed=seed,
        arm=drawn.bench.kind.name,
        channel="position",
        causes=causes_of(drawn.parts),
        floor_rms=drawn.bench.floor,
        gap_rms=drawn.gap_rms,
        withhold=effects if kind.startswith("withheld:") else (),
        facts=facts,
    )
