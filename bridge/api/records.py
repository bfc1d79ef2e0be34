"""Results as small frozen records; ``to_json`` gives plain lists and numbers, SI units."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gapbridge.bridge.cell import Cell, save_cell
from gapbridge.bridge.document.json_text import finite
from gapbridge.bridge.document.output_file import (
    require_cell,
    require_folder,
    require_table,
    require_writable,
    write_table,
    write_text,
    write_together,
)
from gapbridge.bridge.document.provenance import fitted, provenance
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.fitted_range import range_of
from gapbridge.core.log.columns import as_table
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogFinding
from gapbridge.core.model import Model

if TYPE_CHECKING:
    from gapbridge.core.diagnosis.diagnosis import Diagnosis


REPORT_FILES = ("diagnosis.json", "report.html")  # in the folder of a diagnosis' report


@dataclass(frozen=True)
class Predicted:
    """Predicted TCP poses of N rows, in the base frame."""

    position: Array  # (N, 3) m
    rotation_vector: Array  # (N, 3) rad
    position_std: Array | None = None  # (N, 3) m, 1 sigma in base axes; None: nothing was fitted
    outside: Mask | None = None  # (N,) outside what was fitted; None: nothing was
    channels: dict[str, Array] = field(default_factory=dict)  # (N, k) by name, where asked for
    needs: dict[str, str] = field(default_factory=dict)  # missing columns or settings of a channel
    sources: dict[str, list[Path]] = field(default_factory=dict)  # log and cell, by role

    @property
    def columns(self) -> dict[str, Array]:
        """Return all predictions by the command's names: (N, k), or (N,) without a number."""
        columns = {
            "predicted_position": self.position, "predicted_rotation": self.rotation_vector,
            "predicted_position_std": self.position_std,
            "outside_fitted": None if self.outside is None else self.outside.astype(float),
            **self.channels,
        }  # fmt: skip
        return {name: values for name, values in columns.items() if values is not None}

    def save(self, path: Path | str) -> None:
        """Write the columns as CSV or Parquet, as ``gapbridge predict`` does."""
        write_table(require_table(Path(path)), *as_table(self.columns))

    def to_json(self) -> dict[str, Any]:
        """Return the predictions as lists, by the command's names, null where there is none.

        Key ``provenance`` holds version, time, arguments, SHA-256 of log and cell.
        """
        origin = provenance(self.sources, "predict", channels=bool(self.channels or self.needs))
        return {**finite(self.columns), "provenance": origin}


@dataclass(frozen=True)
class Corrected:
    """Offset-corrected setpoints of N rows."""

    q: Array  # (N, n) rad
    residual: Array  # (N,) m: distance of the predicted from the intended pose
    sources: dict[str, list[Path]] = field(default_factory=dict)  # log and cell, by role

    def save(self, path: Path | str) -> None:
        """Write the setpoints as CSV or Parquet, as ``gapbridge compensate`` does."""
        write_table(require_table(Path(path)), *as_table({"corrected_q": self.q}))

    def to_json(self) -> dict[str, Any]:
        """Return setpoints and residuals as lists, and their provenance; see Predicted."""
        return {
            "corrected_q": self.q.tolist(), "residual": self.residual.tolist(),
            "provenance": provenance(self.sources, "compensate"),
        }  # fmt: skip


@dataclass(frozen=True)
class Fitted:
    """Joint flexibilities identified from a log; (n,) each, rad/Nm."""

    cell: Cell  # the input
    model: Model  # the cell's, with the flexibilities
    axial: Array
    radial: Array
    std_axial: Array  # 1 sigma
    std_radial: Array
    shown: Mask  # (2n,), axial then radial: identifiable from the data; others are the cell's
    samples: int
    gap_rms: float  # m, one coordinate, before
    remaining_rms: float  # m, after
    remaining_rms_held_out: float | None  # m, on held-out poses
    notes: tuple[str, ...]
    provenance: dict[str, Any]

    def save(self, path: Path | str) -> None:
        """Write the cell with the fitted flexibilities, as ``gapbridge fit`` does."""
        _save(self.cell, path, self.model, self.provenance)

    def to_json(self) -> dict[str, Any]:
        """Return the figures as lists and numbers."""
        return {
            "axial": self.axial.tolist(), "radial": self.radial.tolist(),
            "std_axial": finite(self.std_axial), "std_radial": finite(self.std_radial),
            "shown": self.shown.tolist(), "samples": self.samples, "gap_rms": self.gap_rms,
            "remaining_rms": self.remaining_rms,
            "remaining_rms_held_out": self.remaining_rms_held_out, "notes": list(self.notes),
            "provenance": self.provenance,
        }  # fmt: skip


@dataclass(frozen=True)
class Diagnosed:
    """The diagnosis of a log: the document that ``gapbridge diagnose --json`` writes."""

    cell: Cell  # the input
    log: Log
    diagnosis: Diagnosis = field(repr=False)  # as the core has it
    document: dict[str, Any] = field(repr=False)  # schema gapbridge.diagnosis/1, with provenance

    @property
    def verdict(self) -> str:
        """Return no_gap, explained, partly_explained or unexplained."""
        return self.diagnosis.verdict.value

    @property
    def model(self) -> Model:
        """Return the model with the causes added."""
        return self.diagnosis.model

    @property
    def causes(self) -> tuple[str, ...]:
        """Return the effects named as causes, strongest channel first, each once."""
        return self._effects("causes")

    @property
    def stand_ins(self) -> tuple[str, ...]:
        """Return effects that are not confirmed but reduce the gap in held-out regions."""
        return self._effects("stand_ins")

    def save(self, path: Path | str, *, stand_ins: bool = False) -> None:
        """Write the cell with the causes added, as ``--apply`` (``--stand-ins``) does.

        No cause is written where poses or weights are another arm's: nothing that is fitted holds.
        None of a channel whose readings are not what they should be is written.
        """
        from gapbridge.bridge.api.uncertainty import (
            cause_entries,
            intervals_applied,
            spread_of,
            without_misread,
        )

        cell = self.cell
        diagnosis = without_misread(self.diagnosis, cell.model, self.log)
        if any(isinstance(f, LogFinding) and f.forbids_fit for f in diagnosis.findings):
            origin = fitted(
                self.document["provenance"], cell.fitted_range, cell.spread, cell.intervals,
                [entry.model_dump() for entry in cell.causes],
            )  # fmt: skip
            _save(cell, path, cell.model, origin)
            return
        spread = spread_of(diagnosis).beside(cell.spread)
        origin = fitted(
            self.document["provenance"], range_of(self.log), spread,
            cell.intervals | intervals_applied(diagnosis, stand_ins=stand_ins),
            cause_entries(diagnosis, cell.causes),
        )  # fmt: skip
        _save(cell, path, diagnosis.with_stand_ins if stand_ins else diagnosis.model, origin)

    def write_report(self, folder: Path | str) -> list[Path]:
        """Write diagnosis.json and report.html, as ``--out`` does; returns their paths."""
        from gapbridge.bridge.report import report_text  # loaded only here

        folder = Path(folder)
        require_folder(folder, "the report", above=False)
        document, report = (require_writable(folder / name) for name in REPORT_FILES)
        origin, name = self.document["provenance"], str(self.cell.path)
        html = report_text(self.diagnosis, name, self.log, self.cell.model, origin)
        return write_together({document: self._json_text(), report: html})

    def write_json(self, path: Path | str) -> None:
        """Write the document, as ``--json`` does."""
        write_text(require_writable(Path(path)), self._json_text())

    def to_json(self) -> dict[str, Any]:
        """Return the document, schema ``gapbridge.diagnosis/1``."""
        return self.document

    def _json_text(self) -> str:
        return json.dumps(self.document, indent=1, allow_nan=False) + "\n"

    def _effects(self, key: str) -> tuple[str, ...]:
        effects = [c["effect"] for channel in self.document["channels"] for c in channel[key]]
        return tuple(dict.fromkeys(effects))


def _save(cell: Cell, path: Path | str, model: Model, origin: dict[str, Any]) -> None:
    """Write a cell.

    Raises InputError where it cannot be written, is no YAML file, or is the one it came from.
    """
    save_cell(cell, require_cell(Path(path), cell.path), model, {"provenance": origin})
