"""One log, one judgement: the diagnosis and plain least squares on rows that neither has seen.

The diagnosis is a program of its own (``gapbridge diagnose``). It sees the rows to fit and writes
a cell; what that cell leaves of the other rows is measured here for positions (``gapbridge
predict``, frame fitted) and by the program's own gap for the other channels.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.real import rivals
from benchmarks.real.absurd import absurdities
from benchmarks.real.geometry import tool_step
from benchmarks.real.sets import HELD_BACK, PUBLISHED, REMOUNTED, SPLIT
from benchmarks.real.table import Table, copy_cell, halves, read_cell, read_table

LIMIT = 3600.0  # s, of one diagnosis: 11,911 poses take a quarter of it
STRETCHES = 10  # of a judged recording, by which the ratio scatters: its rows are no samples
READ = {  # channel: the columns measured and predicted
    "wrench": ("ft_raw_wrench", "predicted_wrench"),
    "tracking": ("actual_q", "predicted_q"),
    "torque": ("actual_current_as_torque", "predicted_torque"),
}


@dataclass(frozen=True)
class Outcome:
    """One channel of one log; figures in the channel's unit, rms per coordinate."""

    log: str
    channel: str
    split: str
    rows: int
    gap: float
    reported: float | None  # the diagnosis' own held-out figure
    reported_new_region: float | None
    judged: float  # what its cell leaves of rows that it did not see
    rival: float  # what plain least squares leave of the same rows
    published: tuple[float, float, str] | None  # ours and theirs, mean length (m), and what
    verdict: str
    accused: tuple[str, ...]
    absurd: tuple[str, ...]
    seconds: float
    unit: str = field(default="")
    ratio_error: float = 0.0  # 1 sigma of judged over rival

    @property
    def ratio(self) -> float:
        """Return judged over the best rival there is."""
        ratios = [self.judged / self.rival]
        if self.published is not None:
            ratios.append(self.published[0] / self.published[1])
        return max(ratios)

    def document(self) -> dict[str, Any]:
        """Return the outcome for JSON."""
        return asdict(self) | {"ratio": self.ratio}


class Program:
    """``gapbridge`` as a command line; raises RuntimeError with what it said."""

    def __init__(self, command: str = "gapbridge", stand_ins: bool = False) -> None:
        """Take the program beside the running interpreter, where it is a bare name."""
        first, *others = shlex.split(command)
        self.words_of_apply = ("--stand-ins",) if stand_ins else ()
        own = Path(sys.executable).parent / first
        self.arguments = (str(own) if own.is_file() and os.sep not in first else first, *others)

    def __call__(self, *arguments: object) -> None:
        """Run one command."""
        try:
            done = subprocess.run([*self.arguments, *map(str, arguments)], capture_output=True,
                                  text=True,
                                  timeout=LIMIT, check=False)  # fmt: skip
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"no answer in {LIMIT:g} s") from None
        if done.returncode:
            output = (done.stderr.strip() or done.stdout.strip()).splitlines()
            raise RuntimeError(f"exit {done.returncode}: {output[-1] if output else 'silent'}")

    def diagnosis(self, log: Path, cell: Path, *arguments: object) -> dict[str, dict[str, Any]]:
        """Return the channels of a diagnosis by name."""
        file = log.with_suffix(".json")
        self("diagnose", log, "--cell", cell, "--json", file, *arguments)
        document = json.loads(file.read_text(encoding="utf-8"))
        return {c["channel"]: c for c in document["channels"]}


@dataclass(frozen=True)
class Answer:
    """What the program found in the rows of a log that it was given."""

    place: Path  # holds train.csv, cell.yaml, and better.yaml with what was found
    source: Path  # the cell
    train: Table
    reported: dict[str, dict[str, Any]]
    seconds: float


def judge_log(
    folder: Path, program: Program, draw: int = 0, poses: int | None = None
) -> Iterator[Outcome]:
    """Yield the outcomes of one log: four fifths fitted, one fifth (drawn by a seed) judged.

    With ``poses`` so many are fitted and others judged. Raises ValueError where there are too few,
    or the log is a recording.
    """
    table = read_table(folder / "log.csv").with_approach()
    if poses is not None and (table.moving or len(table) < 2 * poses):
        raise ValueError(f"found {len(table)} rows, expected at least {2 * poses} poses at rest")
    fitted, judged = (table.rows(keep) for keep in halves(table, draw, poses))
    with tempfile.TemporaryDirectory(prefix="real-") as scratch:
        answer = _answer(folder, fitted, Path(scratch), program)
        yield from _judge(folder.name, answer, judged, program)


def judge_carried(fitted: Path, judged: Sequence[Path], program: Program) -> Iterator[Outcome]:
    """Yield the outcomes of one log's answer carried to others of the same arm."""
    with tempfile.TemporaryDirectory(prefix="real-") as scratch:
        answer = _answer(fitted, read_table(fitted / "log.csv"), Path(scratch), program)
        for folder in judged:
            name = f"{fitted.name} > {folder.name}"
            yield from _judge(name, answer, read_table(folder / "log.csv"), program)


def _answer(folder: Path, train: Table, place: Path, program: Program) -> Answer:
    nominal = copy_cell(folder / "cell.yaml", place)
    train.write(place / "train.csv")
    arguments: list[object] = ["--apply", place / "better.yaml", *program.words_of_apply]
    arguments += ["--remounted"] if folder.name in REMOUNTED and _knows(program) else []
    start = time.perf_counter()
    reported = program.diagnosis(place / "train.csv", nominal, *arguments)
    seconds = time.perf_counter() - start
    return Answer(place, folder / "cell.yaml", train, reported, seconds)


def _judge(name: str, answer: Answer, test: Table, program: Program) -> list[Outcome]:
    place, train, reported = answer.place, answer.train, answer.reported
    test.write(place / "test.csv")
    channels = [c for c in train.channels() if c in reported]
    after: dict[str, dict[str, Any]] = {}
    if set(channels) - {"position"}:
        after = program.diagnosis(place / "test.csv", place / "better.yaml")
    out = []
    for channel in channels:
        ours = _left(name, channel, program, place, train, test)
        judged = float(after[channel]["gap_rms"]) if channel in after else _rms(ours)
        theirs, rival = _rival(channel, answer, test, program)
        if channel in ("wrench", "tracking"):  # a diagnosis leaves out outliers, each its own
            ours, theirs = _comparable(channel, ours, theirs)
            judged, rival = _rms(ours), _rms(theirs)
        published = _published(name, ours) if channel == "position" else None
        sizes = judged, rival, ratio_error(ours, theirs, test.moving)
        out.append(_outcome(name, channel, answer, sizes, published))
    return out


def _knows(program: Program) -> bool:
    output = subprocess.run([*program.arguments, "diagnose", "--help"], capture_output=True,
                            text=True,
                          timeout=60, check=False).stdout  # fmt: skip
    return "--remounted" in output


def _left(
    name: str, channel: str, program: Program, place: Path, train: Table, test: Table
) -> np.ndarray:
    """Return what the written cell leaves of the judged rows (N, k); nan where it says nothing."""
    if channel != "position":
        return _gap(channel, program, place, test, "better")
    predicted, turned = _predicted(program, place, "test")
    if name in REMOUNTED:  # as the rival: each session's tool point as the fitted rows have it
        p, R = _predicted(program, place, "train")
        for s in np.unique(rivals.sessions(test)):
            own, judged = rivals.sessions(train) == s, rivals.sessions(test) == s
            measured = train.get("measured_position")
            assert measured is not None
            predicted[judged] += turned[judged] @ tool_step(p[own], R[own], measured[own])
    return rivals.left_of(predicted, test)


def _published(name: str, left: np.ndarray) -> tuple[float, float, str] | None:
    theirs = PUBLISHED.get(name)
    if theirs is None:
        return None
    length = float(np.linalg.norm(left, axis=1).mean())
    return length, theirs.mean_length, theirs.what


def _gap(channel: str, program: Program, place: Path, table: Table, cell: str) -> np.ndarray:
    """Return measured minus predicted (N, k) of the rows of test.csv; nan where not predicted."""
    program("predict", place / "test.csv", "--cell", place / f"{cell}.yaml", "--channels",
            "--out", place / "channels.csv")  # fmt: skip
    measured, predicted = READ[channel]
    own, model = table.get(measured), read_table(place / "channels.csv").get(predicted)
    assert own is not None and model is not None
    return np.asarray(own - model)


def _predicted(program: Program, place: Path, rows: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (N, 3) and rotations (N, 3, 3) that the written cell predicts."""
    program("predict", place / f"{rows}.csv", "--cell", place / "better.yaml",
            "--out", place / "predicted.csv")  # fmt: skip
    table = read_table(place / "predicted.csv")
    position, rotation = table.get("predicted_position"), table.get("predicted_rotation")
    assert position is not None and rotation is not None
    return position, Rotation.from_rotvec(rotation).as_matrix()


def _rival(channel: str, answer: Answer, test: Table, program: Program) -> tuple[np.ndarray, float]:
    """Return what plain least squares leave of the judged rows (N, k), and its rms."""
    place, train, cell = answer.place, answer.train, read_cell(answer.source)
    if channel in ("position", "tracking"):
        left = (
            rivals.position_left(cell, train, test) if channel == "position"
            else rivals.tracking_left(train, test)
        )  # fmt: skip
        return left, _rms(left)
    if channel == "torque":
        nominal = _gap(channel, program, place, test, "cell")
        corrected = rivals.torque_corrected(cell, answer.source.parent, train, test, nominal)
    else:
        corrected = rivals.wrench_corrected(cell, train, test)
    corrected.write(place / "corrected.csv")  # on the rows that the program judges
    seen = program.diagnosis(place / "corrected.csv", place / "cell.yaml")
    left = _gap(channel, program, place, corrected, "cell")
    return left, float(seen[channel]["gap_rms"])


def _comparable(
    channel: str, ours: np.ndarray, theirs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals (m, k) of the rows that have both.

    Of wrenches in N: the torques of ``theirs`` count as much as its forces. Without torques to
    speak of they count nothing.
    """
    both = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    ours, theirs = ours[both], theirs[both]
    if channel != "wrench":
        return ours, theirs
    force, torque = _rms(theirs[:, :3]), _rms(theirs[:, 3:])
    weight = np.repeat([1.0, force / torque if torque > 1e-9 * force else 0.0], 3)
    return ours * weight, theirs * weight


def ratio_error(ours: np.ndarray, theirs: np.ndarray, moving: bool) -> float:
    """Return 1 sigma of the ratio of two rms (N, k) of the same rows: a jackknife.

    Over single poses, or over stretches of a recording, whose neighbouring rows are no samples of
    their own.
    """
    a, b = (np.sum(left**2, axis=1) for left in (ours, theirs))
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both], b[both]
    count = STRETCHES if moving else len(a)
    part = np.arange(len(a)) * count // len(a)
    less_a, less_b = (np.sum(x) - np.bincount(part, x, count) for x in (a, b))
    ratio = np.sqrt(less_a / less_b)
    return float(np.sqrt((count - 1) * np.var(ratio)))


def _outcome(
    name: str, channel: str, answer: Answer, sizes: tuple[float, float, float],
    published: tuple[float, float, str] | None,
) -> Outcome:  # fmt: skip
    train, reported = answer.train, answer.reported[channel]
    mass = train.get("payload")
    least, largest = (
        (float(np.nanmin(mass)), float(np.nanmax(mass))) if mass is not None else (0, 0)
    )
    return Outcome(
        log=name,
        channel=channel,
        split=SPLIT.get(name.rpartition(" > ")[2], HELD_BACK),
        rows=len(train),
        gap=float(reported["gap_rms"]),
        reported=reported.get("remaining_rms_held_out"),
        reported_new_region=reported.get("remaining_rms_new_region"),
        judged=sizes[0],
        rival=sizes[1],
        published=published,
        verdict=str(reported["verdict"]),
        accused=tuple(_accused(c) for c in reported["causes"]),
        absurd=tuple(absurdities(reported["causes"], least, largest)),
        seconds=answer.seconds,
        unit=str(reported["unit"]),
        ratio_error=sizes[2],
    )


def _accused(cause: dict[str, Any]) -> str:
    joints = ",".join(str(j) for j in cause.get("joints") or [])
    return f"{cause['effect']}({joints})" if joints else str(cause["effect"])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
