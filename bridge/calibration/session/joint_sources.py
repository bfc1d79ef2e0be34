"""Which way a session learns where the arm stands."""

from __future__ import annotations

from pathlib import Path

from gapbridge.bridge.calibration.instruments.instrument import Ask
from gapbridge.bridge.calibration.joints.joint_source import JointSource, PlannedJoints, TypedJoints
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import TOUCHED
from gapbridge.bridge.cell import Cell
from gapbridge.core.errors import CellError


def make_joints(cell: Cell, options: SessionOptions, ask: Ask, folder: Path) -> JointSource:
    """Return how joints are known, not yet open. Raises CellError where the cell does not fit."""
    given = cell.calibration
    source = given.joints or ("link" if cell.link is not None else "typed")
    if source != "link":
        if options.move:
            raise CellError(
                f"{cell.path}: calibration.joints: found {source!r} with --move, expected 'link'"
            )
        seated = options.kind == "tool" or options.instrument.measures in TOUCHED
        return TypedJoints(ask, seated) if source == "typed" else PlannedJoints()
    if cell.link is None:
        raise CellError(f"{cell.path}: link: found nothing, expected the robot's address")
    if options.move and not cell.link.moves_arm:
        raise CellError(
            f"{cell.path}: link.driver: found {cell.link.driver!r}, which cannot move the arm; "
            "expected another for --move, or jog it"
        )
    from gapbridge.bridge.calibration.joints.link import LinkedJoints

    return LinkedJoints(cell, given.settle, given.speed, folder, options.move)
