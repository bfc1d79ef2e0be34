"""The cell: one file that says which arm stands there, what it carries and how it is reached."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from gapbridge.bridge.cell.document import read_document
from gapbridge.bridge.cell.effects import compliance_terms, term_of
from gapbridge.bridge.cell.message import key_path, message, messages
from gapbridge.bridge.cell.plausibility import findings
from gapbridge.bridge.cell.robot import build_arm
from gapbridge.bridge.cell.schema import CauseEntry, CellFile, Simulation
from gapbridge.bridge.cell.sections import (
    LimitSettings,
    LinkSettings,
    RecordingSettings,
    SetpointSettings,
)
from gapbridge.bridge.cell.settings.calibration import CalibrationSettings
from gapbridge.bridge.cell.settings.web import MetricsSettings, WebSettings
from gapbridge.core.arm import Arm
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.errors import ArmError, CellError, InputError
from gapbridge.core.files import Document
from gapbridge.core.load_bounds import PAYLOAD_FACTOR
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model, Uncertain
from gapbridge.core.rotation import rpy_matrix, transform
from gapbridge.drivers.ft_sensor.settings import FtSensorSettings

FINEST = 1.0e-9  # m: what a sigma of zero counts as


@dataclass(frozen=True)
class Cell:
    """A cell file that has been read and checked."""

    path: Path
    file: CellFile
    document: Document
    model: Model
    metrology: Metrology
    warnings: tuple[str, ...] = ()

    @property
    def arm(self) -> Arm:
        """Return the nominal arm."""
        return self.model.arm

    @property
    def link(self) -> LinkSettings | None:
        """Return section ``link``, its paths made absolute; None where the cell has none.

        Raises InputError where a file that it names cannot be used.
        """
        given = self.file.link
        try:
            return None if given is None else given.located(self.path.parent)
        except InputError as error:
            raise type(error)(f"{self.path}: {error}") from None

    @property
    def ft_sensor(self) -> FtSensorSettings | None:
        """Return section ``ft_sensor``; None where the cell has none."""
        return self.file.ft_sensor

    @property
    def limits(self) -> LimitSettings:
        """Return section ``limits``."""
        return self.file.limits

    @property
    def setpoints(self) -> SetpointSettings:
        """Return section ``setpoints``, its paths made absolute."""
        return self.file.setpoints.located(self.path.parent)

    @property
    def recording(self) -> RecordingSettings:
        """Return section ``recording``, its folder made absolute."""
        return self.file.recording.located(self.path.parent)

    @property
    def web(self) -> WebSettings | None:
        """Return section ``web``, its paths made absolute; None where the cell has none."""
        given = self.file.web
        return None if given is None else given.located(self.path.parent)

    @property
    def metrics(self) -> MetricsSettings | None:
        """Return section ``metrics``, its paths made absolute; None where the cell has none."""
        given = self.file.metrics
        return None if given is None else given.located(self.path.parent)

    @property
    def calibration(self) -> CalibrationSettings:
        """Return section ``calibration``, its paths made absolute."""
        return self.file.calibration.located(self.path.parent)

    @property
    def fitted_range(self) -> dict[str, tuple[float, float]]:
        """Return the least and largest value of each log column that the model was fitted on."""
        origin = self.file.provenance
        return {} if origin is None else dict(origin.fitted)

    @property
    def spread(self) -> Spread:
        """Return the covariance of what was fitted; of nothing where the cell has none."""
        origin = self.file.provenance
        if origin is None or not origin.parameters:
            return Spread.none()
        return Spread(tuple(origin.parameters), np.array(origin.covariance, dtype=float))

    @property
    def uncertain(self) -> Uncertain | None:
        """Return what the diagnosis asks of how unsure the model's numbers are; None: not known."""
        return partial(self.spread.sigma_columns, self.model) if self.spread.names else None

    @property
    def causes(self) -> tuple[CauseEntry, ...]:
        """Return what a diagnosis accused, as the cell's provenance has it."""
        origin = self.file.provenance
        return () if origin is None else tuple(origin.causes)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """Return the 95 % interval of each number that was applied, by name, SI."""
        origin = self.file.provenance
        return {} if origin is None else dict(origin.intervals)

    @property
    def simulation(self) -> Simulation:
        """Return section ``simulation``."""
        return self.file.simulation


def load_cell(path: Path | str) -> Cell:
    """Return the cell of a YAML file.

    Raises CellError (or ArmError) with one line that names file, line, key, what was found and
    what was expected.
    """
    path = Path(path)
    document = read_document(path)
    try:
        # a key with nothing behind it counts as left out
        given = {key: value for key, value in document.data.items() if value is not None}
        file = CellFile.model_validate(given)
    except ValidationError as error:
        raise CellError(message(document, CellFile, error)) from None
    return cell_of(file, document)


def complaints(path: Path) -> list[str]:
    """Return a line for everything that is wrong with a cell file; none where it can be loaded.

    Where keys do not fit, their values are not looked at.
    """
    document = read_document(path)
    try:
        file = CellFile.model_validate({k: v for k, v in document.data.items() if v is not None})
    except ValidationError as error:
        return messages(document, CellFile, error)
    try:
        found = findings(file, document, build_arm(file.robot, path.parent)).errors
        if not found:
            cell_of(file, document)
    except (ArmError, CellError) as error:
        found = [placed(document, str(error))]
    return found


def cell_of(file: CellFile, document: Document) -> Cell:
    """Return the cell of a file's keys; raises CellError where they do not fit each other."""
    path = document.path
    try:
        arm = build_arm(file.robot, path.parent)
        found = findings(file, document, arm)
        if found.errors:
            raise CellError(found.errors[0])
        warnings = _check_payload(file, arm)
        if file.robot.tip is not None and file.robot.urdf is None:
            warnings.append("robot.tip: means nothing without robot.urdf")
        terms = compliance_terms(file.compliance, arm) + tuple(
            term_of(entry, arm, f"effects entry {i + 1}") for i, entry in enumerate(file.effects)
        )
    except (ArmError, CellError) as error:
        raise type(error)(placed(document, str(error))) from None
    tcp = file.tool.tcp
    model = Model(
        arm=arm,
        tool_in_flange=transform(rpy_matrix(np.array(tcp.rpy)), np.array(tcp.xyz)),
        payload_mass=file.payload.mass,
        payload_cog=np.array(file.payload.cog),
        gravity=np.array(file.gravity),
        reference_temperature=file.reference_temperature,
        terms=terms,
    )
    entry = file.metrology
    metrology = Metrology(entry.registered, max(entry.sigma, FINEST), entry.repeatability)
    return Cell(
        path,
        file,
        document,
        model,
        metrology,
        (*found.warnings, *(placed(document, w) for w in warnings)),
    )


def placed(document: Document, text: str) -> str:
    """Return a message with its file, and the line of the key that it begins with."""
    path = str(document.path)
    if text.startswith(path):
        return text
    name = text.partition(":")[0]
    # the key itself, or the nearest that holds it
    named = [k for k in _paths((), document.data) if f"{name}.".startswith(f"{key_path(k)}.")]
    line = document.line(max(named, key=len)) if named else None
    return f"{path}: {text}" if line is None else f"{path}, line {line}: {text}"


def _paths(keys: tuple[str | int, ...], value: object) -> Iterator[tuple[str | int, ...]]:
    """Yield the path of every key and entry."""
    entries: Iterable[tuple[Any, object]] = ()
    if isinstance(value, dict):
        entries = value.items()
    elif isinstance(value, list):
        entries = enumerate(value)
    for key, own in entries:
        yield (*keys, key)
        yield from _paths((*keys, key), own)


def _check_payload(file: CellFile, arm: Arm) -> list[str]:
    mass, rated = file.payload.mass, arm.payload
    if mass > PAYLOAD_FACTOR * rated:
        raise CellError(
            f"payload.mass: found {mass:g} kg, out of range: expected 0 to {rated:g} kg, what "
            f"{arm.name} is rated for"
        )
    if mass > rated:
        return [f"payload.mass: {mass:g} kg is more than {arm.name} is rated for ({rated:g} kg)"]
    return []
