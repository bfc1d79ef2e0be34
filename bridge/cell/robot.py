"""The arm of a cell: a built-in model, a URDF or DH rows."""

from __future__ import annotations

import configparser
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from gapbridge.bridge.cell.schema import Calibration, Robot
from gapbridge.core.arm import Arm, arm_from_dh, builtin_arm
from gapbridge.core.errors import ArmError, CellError, first_line
from gapbridge.core.files import is_file, quoted, read_text
from gapbridge.core.urdf import arm_from_urdf

URDF, CALIBRATION = ("robot", "urdf"), ("robot", "calibration")  # keys of the cell file
DELTAS = ("delta_theta", "delta_a", "delta_d", "delta_alpha")


def build_arm(robot: Robot, folder: Path) -> Arm:
    """Return the arm that the robot section names; paths are relative to ``folder``.

    Raises CellError (or ArmError) with the keys of what cannot be used.
    """
    kinds = [kind for kind in ("model", "urdf", "dh") if getattr(robot, kind) is not None]
    if len(kinds) > 1 and not robot.dh:
        kinds = [kind for kind in kinds if kind != "dh"]  # an empty list counts as left out
    if len(kinds) != 1:
        found = " and ".join(kinds) or "none of them"
        raise CellError(f"found {found}, expected one of model, urdf, dh", ("robot",))
    if robot.calibration is not None and robot.model is None:
        raise CellError(
            f"found beside robot.{kinds[0]}, expected only beside robot.model", CALIBRATION
        )
    if robot.rated_payload is not None and robot.model is not None:
        raise CellError(
            "found beside robot.model, expected only beside robot.urdf or robot.dh: that of a "
            "built-in arm is known",
            ("robot", "rated_payload"),
        )
    if robot.model is not None:
        return _calibrated_arm(robot.model, robot.calibration, folder)
    if robot.urdf is not None:
        path = folder / robot.urdf
        if not is_file(path):
            raise CellError(f"file not found: {path}, expected a URDF", URDF)
        try:
            arm = arm_from_urdf(path, robot.tip)
        except ArmError as error:
            raise ArmError(str(error), URDF) from None
        except RecursionError:
            raise ArmError(f"{path}: found links nested too deep, expected fewer", URDF) from None
    else:
        arm = arm_from_dh([row.model_dump() for row in robot.dh or []])
    rated = robot.rated_payload
    return arm if rated is None else replace(arm, payload=rated)


def _calibrated_arm(model: str, calibration: Calibration | Path | None, folder: Path) -> Arm:
    try:
        return builtin_arm(model, calibration_of(calibration, folder))
    except ArmError as error:
        keys = tuple(error.keys or ())
        if not isinstance(calibration, Path) or keys[:2] != CALIBRATION or len(keys) == 2:
            raise
        message = f"{folder / calibration}: {keys[2]}: {error.message}"
        raise ArmError(message, CALIBRATION) from None


def calibration_of(
    calibration: Calibration | Path | None, folder: Path
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
        parser.read_string(read_text(path, "utf-8-sig"), source=str(path))
    except FileNotFoundError:
        raise ArmError(
            f"file not found: {path}, expected a calibration.conf", CALIBRATION
        ) from None
    except OSError as error:
        raise ArmError(
            f"{path} cannot be read ({first_line(error)}), expected a calibration.conf", CALIBRATION
        ) from None
    except (UnicodeDecodeError, configparser.Error):
        raise ArmError(
            f"{path}: found no sections of keys and values, expected a calibration.conf",
            CALIBRATION,
        ) from None
    deltas: dict[str, list[float]] = {}
    for section in parser.sections():
        for key in DELTAS:
            if parser.has_option(section, key):
                deltas[key] = _numbers(path, key, parser.get(section, key))
    if not deltas:
        raise ArmError(f"{path}: found none of {', '.join(DELTAS)}", CALIBRATION)
    return deltas


def _numbers(path: Path, key: str, text: str) -> list[float]:
    try:
        values = json.loads(text)
        if isinstance(values, list) and all(type(v) in (int, float) for v in values):
            numbers = [float(value) for value in values]
            if all(map(math.isfinite, numbers)):
                return numbers
    except (ValueError, OverflowError, RecursionError):
        pass
    raise ArmError(
        f"{path}: {key}: found {quoted(text)}, expected a list of finite numbers", CALIBRATION
    )
