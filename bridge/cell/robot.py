"""The arm of a cell: a built-in model, a URDF or DH rows."""

from __future__ import annotations

import configparser
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from gapbridge.bridge.cell.schema import Calibration, Robot
from gapbridge.core.arm import Arm, arm_from_dh, builtin_arm
from gapbridge.core.errors import ArmError, CellError
from gapbridge.core.files import is_file, read_text
from gapbridge.core.urdf import arm_from_urdf

DELTAS = ("delta_theta", "delta_a", "delta_d", "delta_alpha")


def build_arm(robot: Robot, folder: Path) -> Arm:
    """Return the arm that the robot section names; paths are relative to ``folder``.

    Raises CellError (or ArmError, naming the URDF) if the section or one of its files cannot be
    used; messages begin with the key.
    """
    kinds = [kind for kind in ("model", "urdf", "dh") if getattr(robot, kind) is not None]
    if len(kinds) > 1 and not robot.dh:
        kinds = [kind for kind in kinds if kind != "dh"]  # an empty list counts as left out
    if len(kinds) != 1:
        found = " and ".join(kinds) or "none of them"
        raise CellError(f"robot: found {found}, expected one of model, urdf, dh")
    if robot.calibration is not None and robot.model is None:
        raise CellError(
            f"robot.calibration: found beside robot.{kinds[0]}, expected only beside robot.model"
        )
    if robot.rated_payload is not None and robot.model is not None:
        raise CellError(
            "robot.rated_payload: found beside robot.model, expected only beside robot.urdf or "
            "robot.dh: that of a built-in arm is known"
        )
    if robot.model is not None:
        return builtin_arm(robot.model, calibration_of(robot.calibration, folder))
    if robot.urdf is not None:
        path = folder / robot.urdf
        if not is_file(path):
            raise CellError(f"robot.urdf: file not found: {path}, expected a URDF")
        arm = arm_from_urdf(path, robot.tip)
    else:
        arm = arm_from_dh([row.model_dump() for row in robot.dh or []])
    rated = robot.rated_payload
    return arm if rated is None else replace(arm, payload=rated)


def calibration_of(
    calibration: Calibration | str | None, folder: Path
) -> Mapping[str, Sequence[float]] | None:
    """Return the DH deltas (rad, m, per joint) of ``robot.calibration`` or of the file it names.

    None if it is left out. Raises ArmError if the file cannot be used.
    """
    if calibration is None:
        return None
    if isinstance(calibration, Calibration):
        return {key: value for key in DELTAS if (value := getattr(calibration, key)) is not None}
    return read_calibration(folder / calibration)


def read_calibration(path: Path) -> dict[str, list[float]]:
    """Return the deltas of a UR controller's ``calibration.conf`` (an INI file).

    Raises ArmError if the file is missing, is no INI file or contains no deltas.
    """
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(read_text(path), source=str(path))
    except FileNotFoundError:
        raise ArmError(
            f"robot.calibration: file not found: {path}, expected a calibration.conf"
        ) from None
    except (OSError, UnicodeDecodeError, configparser.Error) as error:
        what = " ".join(str(error).split())
        raise ArmError(f"robot.calibration: {path} cannot be read: {what}") from None
    deltas: dict[str, list[float]] = {}
    for section in parser.sections():
        for key in DELTAS:
            if parser.has_option(section, key):
                deltas[key] = _numbers(path, key, parser.get(section, key))
    if not deltas:
        raise ArmError(f"robot.calibration: {path}: found none of {', '.join(DELTAS)}")
    return deltas


def _numbers(path: Path, key: str, text: str) -> list[float]:
    try:
        return [float(value) for value in json.loads(text)]
    except (ValueError, TypeError):
        raise ArmError(
            f"robot.calibration: {path}: {key}: found {text!r}, expected a list of numbers"
        ) from None
