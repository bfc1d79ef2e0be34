"""LeRobot datasets (v2.1 and v3): ``action`` is target_q, ``observation.state`` is actual_q."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError, LogOptionError
from gapbridge.core.files import quoted
from gapbridge.core.log.sources.joint_order import order_joints
from gapbridge.core.log.sources.source import Converted, Source, SourceOptions
from gapbridge.core.notes import Note, Reason

if TYPE_CHECKING:
    import pyarrow

INFO = Path("meta") / "info.json"
STEPS = 4095  # of an encoder turn, as LeRobot counts its servos' 4096 positions
PAUSE = 1.0  # s between two episodes, whose own times all begin at 0


class LeRobot(Source):
    """A dataset of teleoperated or played episodes."""

    identifier = "lerobot"
    title = "LeRobot dataset (folder with meta/info.json)"
    options = ("joints", "calibration", "units", "episode")

    def holds(self, path: Path) -> bool:
        """Return whether this is a dataset."""
        return path.is_dir() and (path / INFO).is_file()

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log of a dataset; see ``Source.read``."""
        info = _info(path)
        names = [name.removesuffix(".pos") for name in _names(path, info, "observation.state")]
        commanded = [name.removesuffix(".pos") for name in _names(path, info, "action")]
        order = order_joints(path, names, arm_joints, options.joints)
        for name in order:
            if name not in commanded:
                raise LogError(
                    f"{path}: action: found {', '.join(commanded)}, expected {name} among them"
                )
        widths = {"action": len(commanded), "observation.state": len(names)}
        table = _table(path, options.episode, widths)
        scale = _scale(path, order, options)
        columns = {"timestamp": _running_time(table["timestamp"], table["episode_index"])}
        for column, key, found in (
            ("target_q", "action", commanded), ("actual_q", "observation.state", names),
        ):  # fmt: skip
            columns[column] = table[key][:, [found.index(name) for name in order]] * scale
        fps = _fps(path, info)
        episodes = len(np.unique(table["episode_index"]))
        notes = [Note(Reason.FRAME_TIMES, (fps, 1e3 / fps))]
        notes += [
            Note(Reason.MISSING, (missing, column))
            for column in ("target_q", "actual_q")
            if (missing := int(np.isnan(columns[column]).any(axis=1).sum()))
        ]
        if episodes > 1:
            notes.append(Note(Reason.EPISODES, (episodes, PAUSE)))
        if options.calibration is not None:
            notes.append(Note(Reason.MIDDLE_ZERO))
        return Converted(columns, order, tuple(notes))


def _info(path: Path) -> dict[str, Any]:
    try:
        found = json.loads((path / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise LogError(f"{path / INFO}: found no readable JSON ({error})") from None
    if not isinstance(found, dict) or not isinstance(found.get("features"), dict):
        raise LogError(f"{path / INFO}: features: not found, expected the dataset's columns")
    return found


def _names(path: Path, info: dict[str, Any], feature: str) -> list[str]:
    """Return the names of a feature's numbers: a list, or a list under one key."""
    given = info["features"].get(feature)
    names = given.get("names") if isinstance(given, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not names:
        raise LogError(
            f"{path / INFO}: features.{feature}.names: found {names!r}, expected joint names"
        )
    return [str(name) for name in names]


def _fps(path: Path, info: dict[str, Any]) -> float:
    """Return the frames per second; 30 if the dataset does not state it."""
    given = info.get("fps", 0)
    try:
        fps = float(given) or 30.0
    except (ValueError, TypeError, OverflowError):
        fps = np.nan
    if not 0.0 < fps < np.inf:
        raise LogError(f"{path / INFO}: fps: found {quoted(given)}, expected a number above 0 (Hz)")
    return fps


def _table(path: Path, episode: int | None, widths: dict[str, int]) -> dict[str, Array]:
    """Return action, observation.state, timestamp and episode_index of all frames in order.

    ``widths``: how many numbers a vector has.
    """
    import pyarrow
    from pyarrow import parquet

    wanted = ["action", "observation.state", "timestamp", "episode_index"]
    files = sorted((path / "data").glob("chunk-*/*.parquet"))
    if not files:
        raise LogError(f"{path / 'data'}: found no chunk-*/*.parquet, expected the frames")
    parts: list[dict[str, Array]] = []
    last = 0
    for file in files:
        try:
            frame = parquet.read_table(pyarrow.OSFile(bytes(file)), columns=wanted)
        except (pyarrow.ArrowException, OSError) as error:
            raise LogError(f"{file}: found no readable frames ({error})") from None
        if episode is not None:
            known = (number for number in frame["episode_index"].to_pylist() if number is not None)
            last = max(0, last, *known)
            frame = frame.filter(pyarrow.compute.equal(frame["episode_index"], episode))
        if frame.num_rows:
            parts.append({name: _numbers(file, frame, name, widths.get(name)) for name in wanted})
    if not parts and episode is None:
        raise LogError(f"{path / 'data'}: found no frames, expected at least one")
    if not parts:
        raise LogOptionError(f"{path}: --episode: found no episode {episode}, expected 0 to {last}")
    return {name: np.concatenate([part[name] for part in parts]) for name in wanted}


def _numbers(file: Path, frame: pyarrow.Table, name: str, width: int | None) -> Array:
    """Return a column: (N,), or vectors (N, width) with NaN where one is missing.

    Raises LogError for what is no number, or infinite.
    """
    try:
        found = np.array(frame[name].to_pylist(), dtype=float)
    except (ValueError, TypeError, OverflowError):
        found = np.empty(0)
    shape = (frame.num_rows,) if width is None else (frame.num_rows, width)
    if found.shape != shape or (width is None and not np.isfinite(found).all()):
        what = "a number" if width is None else f"{width} numbers"
        raise LogError(f"{file}: column {name}: expected {what} in each of {shape[0]} rows")
    if np.isinf(found).any():
        row = int(np.argwhere(np.isinf(found))[0][0]) + 1
        raise LogError(f"{file}: row {row}, column {name}: found inf, expected finite numbers")
    return found


def _running_time(time: Array, episode: Array) -> Array:
    """Return times (N,) that run on from one episode to the next."""
    begins = np.flatnonzero(np.diff(episode, prepend=np.nan) != 0)
    found: Array = time - time[0]
    for begin in begins[1:]:
        found[begin:] += found[begin - 1] - found[begin] + PAUSE
    return found


def _scale(path: Path, order: Sequence[str], options: SourceOptions) -> Array:
    """Return what a number of each joint is in rad (n,).

    By the calibration file a joint's numbers go from -100 to 100 over its range of servo steps.
    """
    if options.units and options.calibration is not None:
        raise LogOptionError(f"{path}: --units: found with --calibration, expected one of them")
    if options.units:
        return np.full(len(order), {"rad": 1.0, "degrees": np.pi / 180}[options.units])
    if options.calibration is None:
        raise LogOptionError(
            f"{path}: units: found none, expected --calibration FILE (the arm's calibration, in "
            "which numbers go from -100 to 100) or --units degrees or rad"
        )
    file = options.calibration
    try:
        given = json.loads(file.read_text(encoding="utf-8"))
        ends = {name: (given[name]["range_min"], given[name]["range_max"]) for name in order}
        span = [float(most) - float(least) for least, most in ends.values()]
    except OSError as error:
        raise LogError(f"{file}: cannot be read ({error.strerror})") from None
    except (ValueError, TypeError, OverflowError, RecursionError):
        raise LogError(f"{file}: found no LeRobot calibration, expected JSON with range_min and "
                       "range_max of each joint") from None  # fmt: skip
    except KeyError as error:
        raise LogError(f"{file}: {error.args[0]}: not found, expected {', '.join(order)} with "
                       "range_min and range_max") from None  # fmt: skip
    for (name, (least, most)), steps in zip(ends.items(), span, strict=True):
        if not 0.0 < steps < np.inf:
            raise LogError(
                f"{file}: {name}: found range_min {least} and range_max {most}, expected a "
                "range of more than 0 steps"
            )
    return np.asarray(np.array(span) / 2 / 100 * 2 * np.pi / STEPS)
