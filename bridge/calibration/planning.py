"""Plans a session from the settings of a cell."""

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
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.calibration.plan import Payload, Plan
from gapbridge.core.errors import InputError, PlanError
from gapbridge.core.metrology import Metrology
from gapbridge.core.planning.design import SessionDesign, load_extent, plan
from gapbridge.core.planning.payload_plan import LIMIT_MARGIN
from gapbridge.core.workspace.capsules import Box
from gapbridge.core.workspace.workspace import Place, Reflector, Workspace

REPEATABILITY = 5e-5  # m, 1 sigma of one coordinate, if the cell does not give it
FIXTURES = {"distance": "fixed end", "sphere": "sphere", "point": "point"}
"""Kinds of readings planned around a fixed object in the cell -> the object."""
CONTACT_KINDS = ("sphere", "point")  # kinds by contact: no instrument looks at the tool


def effects_of(cell: Cell) -> tuple[str, ...]:
    """Return the effects to fit. Raises CellError for one that a calibration cannot fit."""
    for i, name in enumerate(cell.calibration.effects or ()):
        try:
            Parameters.of_effects(cell.model, (name,))
        except InputError as error:
            raise cell.error(("calibration", "effects", i), error.message) from None
    return tuple(cell.calibration.effects or DEFAULT)


def check_session(cell: Cell) -> None:
    """Raise CellError for what a session would refuse in section ``calibration``."""
    effects_of(cell)
    workspace_of(cell, cell.calibration.instrument.measures)


def observable_of(cell: Cell, instrument: Base, places: int = 1) -> Observable:
    """Return the measurement model of the instrument's readings.

    An instrument that was moved, so that it had several ``places``, counts as not registered.
    """
    return make_observable(
        instrument.measures, registered=cell.metrology.registered and places == 1,
        **instrument.options,
    )  # fmt: skip


def metrology_of(cell: Cell, instrument: Base, places: int = 1) -> Metrology:
    """Return registration and noise of the instrument for the fit."""
    declared = cell.metrology
    sigma = instrument.sigma or declared.sigma
    return Metrology(declared.registered and places == 1, sigma, declared.repeatability)


def loads_of(cell: Cell) -> tuple[Payload, ...]:
    """Return the loads of the session; default: the cell's payload alone."""
    entries = cell.calibration.loads
    if not entries:
        return (own_load(cell, "as in the cell"),)
    return tuple(Payload(e.mass, _vector3(e.cog), e.name) for e in entries)


def own_load(cell: Cell, name: str) -> Payload:
    """Return the cell's payload under a name: what the arm carries in a short session."""
    payload = cell.file.payload
    return Payload(payload.mass, _vector3(payload.cog), name)


def make_plan(cell: Cell, options: SessionOptions, emit: Callable[[str, float], None]) -> Plan:
    """Return the plan of a calibration; ``emit`` takes step and progress. Raises InputError."""
    settings, instrument = cell.calibration, options.instrument
    workspace = workspace_of(cell, instrument.measures)
    observable = observable_of(cell, instrument, max(len(workspace.places), 1))
    design = SessionDesign(
        poses=options.poses or settings.poses,
        held_out=settings.held_out,
        repeats=settings.repeats,
        seed=options.seed,
        sigma=float(np.hypot(instrument.sigma or cell.metrology.sigma,
                             cell.metrology.repeatability or REPEATABILITY)),
    )  # fmt: skip
    parameters = identifiable_parameters(cell.model, effects_of(cell), observable=observable)
    try:
        return plan(parameters, observable, loads_of(cell), workspace, design, emit)
    except PlanError as error:
        if error.keys and options.poses:
            raise PlanError(f"--poses: {error.message}") from None
        raise cell.error(error.keys or ("calibration",), error.message) from None


def workspace_of(cell: Cell, kind: str, margin: float = LIMIT_MARGIN) -> Workspace:
    """Return where the arm may be measured with a kind of reading. Raises CellError.

    ``margin`` (rad) is kept to the arm's joint limits where the cell has no ``joint_range``.
    """
    settings, entry = cell.calibration, cell.calibration.reflector
    places = _places(cell, kind)
    lower, upper = _range(cell, settings.joint_range, margin)
    boxes = [Box(_vector3(b.lower), _vector3(b.upper)) for b in _boxes(cell, settings)]
    optic = None
    if entry is not None:
        optic = Reflector(looks=entry.looks, acceptance=entry.acceptance)
    try:
        return Workspace.of(
            cell.model, lower=lower, upper=upper, floor=settings.floor, places=places,
            keep_out=boxes, reflector=optic,
        )  # fmt: skip
    except PlanError as error:
        raise cell.error(("calibration", "joint_range"), str(error)) from None


def _places(cell: Cell, kind: str) -> list[Place]:
    """Return the planned positions of the instrument, with its range. Raises CellError."""
    settings, section = cell.calibration, "calibration"
    if settings.instrument_at is None:
        if kind in FIXTURES:
            raise cell.error(
                (section, "instrument_at"),
                f"found nothing, expected where the {FIXTURES[kind]} is, m, in base, about",
            )
        for key in ("further_places", "instrument_range", "reflector"):
            if getattr(settings, key):
                raise cell.error(
                    (section, "instrument_at"),
                    f"found nothing beside {key}, expected where the instrument stands first, m, "
                    "in base, about",
                )
        return []
    for key in ("instrument_range", "reflector") if kind in CONTACT_KINDS else ():
        if getattr(settings, key):
            raise cell.error(
                (section, key),
                f"found it with a {FIXTURES[kind]} that is touched, expected it only where an "
                "instrument looks at the tool",
            )
    if settings.reflector is not None and not any(settings.reflector.looks):
        raise cell.error((section, "reflector", "looks"), "found no length, expected a direction")
    limits = settings.instrument_range or RangeEntry()
    farthest = np.inf if limits.farthest is None else limits.farthest
    if limits.nearest >= farthest:
        raise cell.error(
            (section, "instrument_range"),
            f"found nearest {limits.nearest:g} and farthest {farthest:g}, expected nearest below "
            "farthest",
        )
    return [
        Place(_vector3(position), limits.nearest, farthest)
        for position in (settings.instrument_at, *settings.further_places)
    ]


def with_loads(workspace: Workspace, loads: Sequence[Payload]) -> Workspace:
    """Return the workspace with the extent of these loads in collision checks."""
    ends = (load_extent(load) for load in loads)
    return replace(workspace, loads_end=(*workspace.loads_end, *ends))


def _boxes(cell: Cell, settings: CalibrationSettings) -> list[BoxEntry]:
    for i, box in enumerate(settings.keep_out):
        if any(a >= b for a, b in zip(box.lower, box.upper, strict=True)):
            raise cell.error(
                ("calibration", "keep_out", i),
                f"found lower {box.lower} and upper {box.upper}, expected lower below upper",
            )
    return list(settings.keep_out)


def _range(cell: Cell, settings: JointRange | None, margin: float) -> tuple[Array, Array]:
    """Return the lowest and highest joints (n,), rad, of a session. Raises CellError."""
    limits, n = cell.arm.limits, cell.arm.n
    if settings is None:  # at its very limit a drive refuses a joint, or its brake engages
        room = (limits.upper - limits.lower) / 4
        kept = np.minimum(max(margin, cell.limits.joint_margin), room)
        return limits.lower + kept, limits.upper - kept
    for name, values in (("lower", settings.lower), ("upper", settings.upper)):
        if len(values) != n:
            raise cell.error(
                ("calibration", "joint_range", name), f"found {len(values)} values, expected {n}"
            )
    for i, (lower, upper) in enumerate(zip(settings.lower, settings.upper, strict=True)):
        if lower >= upper:
            raise cell.error(
                ("calibration", "joint_range", "lower", i),
                f"found {lower:g}, expected less than upper, {upper:g}",
            )
    return np.array(settings.lower), np.array(settings.upper)


def _vector3(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z
