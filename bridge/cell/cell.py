"""The cell file: the arm, its tool and payload, and how its controller is reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from gapbridge.bridge.cell.document import parse, read_document
from gapbridge.bridge.cell.effects import compliance_terms, effect_terms
from gapbridge.bridge.cell.message import error_lines, located, located_message, message_at
from gapbridge.bridge.cell.plausibility import check_plausibility
from gapbridge.bridge.cell.robot import build_arm
from gapbridge.bridge.cell.schema import CauseEntry, CellFile
from gapbridge.bridge.cell.sections import (
    LimitSettings,
    LinkSettings,
    RecordingSettings,
    SetpointSettings,
)
from gapbridge.bridge.cell.settings.calibration import CalibrationSettings
from gapbridge.bridge.cell.settings.web import MetricsSettings, WebSettings
from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.effects import Term
from gapbridge.core.errors import ArmError, CellError, EquilibriumError, InputError, Keys
from gapbridge.core.files import Document
from gapbridge.core.load_bounds import PAYLOAD_FACTOR, LoadBounds
from gapbridge.core.loads import Loads
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model, Uncertain
from gapbridge.core.rotation import rpy_matrix, transform
from gapbridge.drivers.ft_sensor.settings import FtSensorSettings

MIN_SIGMA = 1.0e-9  # m: replaces a sigma of zero


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
    def folder(self) -> Path:
        """Return the absolute folder of the file, which relative paths of side processes mean."""
        return self.path.parent.resolve()

    def error(self, keys: Keys, message: str) -> CellError:
        """Return an error about a key of the file."""
        return CellError(message_at(self.document, keys, message))

    @property
    def link(self) -> LinkSettings | None:
        """Return section ``link``, its paths made absolute; None if the cell has none.

        Raises InputError if a file that it names cannot be used.
        """
        section = self.file.link
        try:
            return None if section is None else section.located(self.path.parent)
        except InputError as error:
            raise located(self.document, error) from None

    @property
    def ft_sensor(self) -> FtSensorSettings | None:
        """Return section ``ft_sensor``; None if the cell has none."""
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
        return self.file.recording.located(self.folder)

    @property
    def web(self) -> WebSettings | None:
        """Return section ``web``, its paths made absolute; None if the cell has none."""
        section = self.file.web
        return None if section is None else section.located(self.folder)

    @property
    def metrics(self) -> MetricsSettings | None:
        """Return section ``metrics``, its paths made absolute; None if the cell has none."""
        section = self.file.metrics
        return None if section is None else section.located(self.folder)

    @property
    def calibration(self) -> CalibrationSettings:
        """Return section ``calibration``, its paths made absolute."""
        return self.file.calibration.located(self.path.parent)

    @property
    def fitted_range(self) -> dict[str, tuple[float, float]]:
        """Return the minimum and maximum of each log column in the data of the fit, in its unit."""
        origin = self.file.provenance
        return {} if origin is None else dict(origin.fitted)

    @property
    def spread(self) -> Spread:
        """Return the covariance of the fitted parameters; an empty one if the cell has none."""
        origin = self.file.provenance
        if origin is None or not origin.parameters:
            return Spread.none()
        return Spread(tuple(origin.parameters), np.array(origin.covariance, dtype=float))

    @property
    def uncertain(self) -> Uncertain | None:
        """Return the model uncertainty as the diagnosis uses it; None if it is unknown."""
        return self._sigma_columns if self.spread.names else None

    def _sigma_columns(self, q: Array, loads: Loads | None, known: Sequence[Term]) -> Array:
        try:
            return self.spread.sigma_columns(self.model, q, loads, known)
        except EquilibriumError:
            raise
        except InputError as error:
            raise located(self.document, error) from None

    @property
    def causes(self) -> tuple[CauseEntry, ...]:
        """Return the causes that a diagnosis named, from the cell's provenance."""
        origin = self.file.provenance
        return () if origin is None else tuple(origin.causes)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """Return the 95 % interval of each fitted or applied parameter, by name, in SI units."""
        origin = self.file.provenance
        return {} if origin is None else dict(origin.intervals)

    @property
    def payload_problem(self) -> InputError | None:
        """Return the error of effects that leave less than no load on the flange; None: none."""
        mass, added = self.model.payload_mass, self.model.added_mass
        if mass + added >= LoadBounds.of(self.model).least:
            return None
        return self.error(
            ("payload", "mass"),
            f"found {mass:g} kg and {added:g} kg of the effects, expected 0 kg or more together",
        )


def load_cell(path: Path | str) -> Cell:
    """Return the cell of a YAML file.

    Raises CellError (or ArmError) with one line that names the file, the line, the key, the value
    found and the value expected.
    """
    return _cell_of(read_document(Path(path)))


def cell_of(text: str, path: Path) -> Cell:
    """Return the cell that a text will be at ``path``; raises as ``load_cell`` does."""
    return _cell_of(parse(text, path))


def _cell_of(document: Document) -> Cell:
    try:
        file = _validated(document)
    except ValidationError as error:
        raise CellError(error_lines(document, CellFile, error)[0]) from None
    return build_cell(file, document)


def _validated(document: Document) -> CellFile:
    """Return the keys of a file; a key without a value counts as left out."""
    return CellFile.model_validate({k: v for k, v in document.data.items() if v is not None})


def cell_errors(path: Path) -> list[str]:
    """Return a line for each error of a cell file; an empty list if it can be loaded.

    Values are checked only if all keys are valid. Raises CellError if it is no YAML mapping.
    """
    document = read_document(path)
    try:
        file = _validated(document)
    except ValidationError as error:
        return error_lines(document, CellFile, error)
    try:
        errors = check_plausibility(file, document, build_arm(file.robot, path.parent)).errors
        if not errors:
            build_cell(file, document)
    except (ArmError, CellError) as error:
        errors = [located_message(document, error)]
    return errors


def build_cell(file: CellFile, document: Document) -> Cell:
    """Return the cell of a file's keys; raises CellError if they contradict each other."""
    path = document.path
    try:
        arm = build_arm(file.robot, path.parent)
        findings = check_plausibility(file, document, arm)
        if findings.errors:
            raise CellError(findings.errors[0])
        warnings = _check_payload(file, arm)
        if file.robot.tip is not None and file.robot.urdf is None:
            warnings.append((("robot", "tip"), "has no effect without robot.urdf"))
        terms = compliance_terms(file.compliance, arm) + effect_terms(file.effects, arm)
    except (ArmError, CellError) as error:
        raise located(document, error) from None
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
    metrology = Metrology(entry.registered, max(entry.sigma, MIN_SIGMA), entry.repeatability)
    return Cell(
        path,
        file,
        document,
        model,
        metrology,
        (*findings.warnings, *(message_at(document, *warning) for warning in warnings)),
    )


def _check_payload(file: CellFile, arm: Arm) -> list[tuple[Keys, str]]:
    """Return the warnings about a payload, each with its keys. Raises CellError."""
    keys, mass, rated = ("payload", "mass"), file.payload.mass, arm.payload
    if mass > PAYLOAD_FACTOR * rated:
        raise CellError(
            f"found {mass:g} kg, out of range: expected 0 to {rated:g} kg, what {arm.name} is "
            "rated for",
            keys,
        )
    if mass > rated:
        return [(keys, f"{mass:g} kg is more than {arm.name} is rated for ({rated:g} kg)")]
    return []
