"""From a cell to the plan of its session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.settings.calibration import (
    BoxEntry,
    CalibrationSettings,
    JointRange,
    RangeEntry,
)
from gapbridge.bridge.cell.settings.instruments import Base
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import DEFAULT
from gapbridge.core.calibration.plan import Payload, Plan
from gapbridge.core.errors import CellError
from gapbridge.core.metrology import Metrology
from gapbridge.core.planning.capsules import Box
from gapbridge.core.planning.design import SessionDesign, load_extent, plan
from gapbridge.core.planning.workspace import Place, Reflector, Workspace

REPEATABILITY = 5e-5  # m, 1 sigma of one coordinate, where the cell does not report it
NEEDS_PLACE = {"distance": "fixed end", "sphere": "sphere", "point": "point"}
"""Kinds that are planned around something fixed in the cell, and what that is."""
TOUCHED = ("sphere", "point")  # kinds without anything that looks at the tool


def effects_of(cell: Cell) -> tuple[str, ...]:
    """Return what is to be found."""
    return tuple(cell.calibration.effects or DEFAULT)


def observable_of(cell: Cell, instrument: Base, places: int = 1) -> Observable:
    """Return how the instrument's readings depend on arm and instrument.

    An instrument that was moved on the way, so that it had several ``places``, is registered at
    none of them.
    """
    return make_observable(
        instrument.measures, registered=cell.metrology.registered and places == 1,
        **instrument.options,
    )  # fmt: skip


def metrology_of(cell: Cell, instrument: Base, places: int = 1) -> Metrology:
    """Return the instrument as the fit takes it."""
    own = cell.metrology
    sigma = instrument.sigma or own.sigma
    return Metrology(own.registered and places == 1, sigma, own.repeatability)


def loads_of(cell: Cell) -> tuple[Payload, ...]:
    """Return the loads that people hang on; the cell's own payload where it names none."""
    entries = cell.calibration.loads
    if not entries:
        own = cell.file.payload
        return (Payload(own.mass, _three(own.cog), "as in the cell"),)
    return tuple(Payload(e.mass, _three(e.cog), e.name) for e in entries)


def planned(cell: Cell, options: SessionOptions, emit: Callable[[str, float], None]) -> Plan:
    """Return the plan of a whole session. Raises InputError where there can be none."""
    given, instrument = cell.calibration, options.instrument
    space = space_of(cell, instrument.measures)
    observable = observable_of(cell, instrument, max(len(space.places), 1))
    return plan(
        identifiable_parameters(cell.model, effects_of(cell), observable=observable),
        observable,
        loads_of(cell),
        space,
        SessionDesign(
            poses=options.poses or given.poses,
            held_out=given.held_out,
            repeats=given.repeats,
            seed=options.seed,
            sigma=float(np.hypot(instrument.sigma or cell.metrology.sigma,
                                 cell.metrology.repeatability or REPEATABILITY)),
        ),
        emit,
    )  # fmt: skip


def space_of(cell: Cell, kind: str) -> Workspace:
    """Return where the arm may be measured. Raises CellError."""
    given, seen = cell.calibration, cell.calibration.reflector
    places = _places(cell, kind)
    lower, upper = _range(cell, given.joint_range)
    return Workspace.of(
        cell.model, lower=lower, upper=upper, floor=given.floor, places=places,
        keep_out=[Box(_three(b.lower), _three(b.upper)) for b in _boxes(cell, given)],
        reflector=None if seen is None else Reflector(looks=seen.looks, acceptance=seen.acceptance),
    )  # fmt: skip


def _places(cell: Cell, kind: str) -> list[Place]:
    """Return where the instrument stands in turn, with its range. Raises CellError."""
    given, where = cell.calibration, f"{cell.path}: calibration"
    if given.instrument_at is None:
        if kind in NEEDS_PLACE:
            raise CellError(
                f"{where}.instrument_at: found nothing, expected where the {NEEDS_PLACE[kind]} is, "
                "m, in base, about"
            )
        for key in ("further_places", "instrument_range", "reflector"):
            if getattr(given, key):
                raise CellError(
                    f"{where}.instrument_at: found nothing beside {key}, expected where the "
                    "instrument stands first, m, in base, about"
                )
        return []
    for key in ("instrument_range", "reflector") if kind in TOUCHED else ():
        if getattr(given, key):
            raise CellError(
                f"{where}.{key}: found it with a {NEEDS_PLACE[kind]} that is touched, expected it "
                "only where an instrument looks at the tool"
            )
    if given.reflector is not None and not any(given.reflector.looks):
        raise CellError(f"{where}.reflector.looks: found no length, expected a direction")
    ends = given.instrument_range or RangeEntry()
    farthest = np.inf if ends.farthest is None else ends.farthest
    if ends.nearest >= farthest:
        raise CellError(
            f"{where}.instrument_range: found nearest {ends.nearest:g} and farthest {farthest:g}, "
            "expected nearest below farthest"
        )
    return [
        Place(_three(at), ends.nearest, farthest)
        for at in (given.instrument_at, *given.further_places)
    ]


def with_loads(space: Workspace, loads: Sequence[Payload]) -> Workspace:
    """Return the space of an arm on whose flange such loads hang, in turn."""
    return replace(space, loads_end=(*space.loads_end, *(load_extent(load) for load in loads)))


def _boxes(cell: Cell, given: CalibrationSettings) -> list[BoxEntry]:
    for i, box in enumerate(given.keep_out):
        if any(a >= b for a, b in zip(box.lower, box.upper, strict=True)):
            raise CellError(
                f"{cell.path}: calibration.keep_out entry {i + 1}: found lower {box.lower} and "
                f"upper {box.upper}, expected lower below upper"
            )
    return list(given.keep_out)


def _range(
    cell: Cell, given: JointRange | None
) -> tuple[list[float] | None, list[float] | None]:  # fmt: skip
    if given is None:
        return None, None
    n = cell.arm.n
    for name, values in (("lower", given.lower), ("upper", given.upper)):
        if len(values) != n:
            raise CellError(
                f"{cell.path}: calibration.joint_range.{name}: found {len(values)} values, "
                f"expected {n}"
            )
    return given.lower, given.upper


def _three(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z
