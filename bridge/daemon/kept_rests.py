"""What the watch over the joints' zeros has learned, kept in a file for the next run.

A collision that ends a run, or a power cycle, must not become the new normal. The file holds poses
and rests while the cell and its files are the same, and a slip until it is acknowledged.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.cell.run_settings import Configuration
from gapbridge.bridge.daemon.slip_watch import MAX_POSES, MAX_RESTS, SlipWatch
from gapbridge.bridge.document.output_file import write_text
from gapbridge.bridge.document.provenance import installed_version
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.rests.rest_comparison import Rest
from gapbridge.core.errors import GapbridgeError
from gapbridge.drivers.clock import Clock

SCHEMA = "gapbridge.rests/1"
EVERY = 60.0  # s between two writes
LONGEST = 4_000_000  # bytes
LONGEST_WAIT = 2.0  # s for the last write: a network mount may hang, and the daemon ends anyway
LARGEST = 1e6  # of any number
SLIP = ("joints", "size", "std", "since", "detail")  # fields of the event


class KeptRests:
    """Reads the file at the start of a run and writes it, in a thread: disks can be slow.

    ``longest_wait``: s of real time for the end of a write.
    """

    def __init__(self, clock: Clock, longest_wait: float = LONGEST_WAIT) -> None:
        self._now, self._longest_wait = clock.monotonic, longest_wait
        self._path: Path | None = None  # None: nothing is kept
        self._text = ""  # written last
        self._due = 0.0  # s, monotonic
        self._slip: Event | None = None  # not acknowledged
        self._is_new = False  # that slip is of an earlier run, and not reported in this one
        self._failed = False  # reported
        self._writing: _Write | None = None

    def open(self, path: Path, watch: SlipWatch, configuration: Configuration) -> str:
        """Have ``watch`` continue with what the file holds; returns why not, if it does not."""
        self._path, self._due = path, self._now() + EVERY
        self._text = self._document(watch, configuration)  # nothing worth a file yet
        try:
            with open(path, "rb") as file:
                data = file.read(LONGEST)
        except FileNotFoundError:
            return ""
        except OSError as error:
            return f"{path}: cannot be read: {error.strerror}; joints' zeros are learned anew"
        self._text = ""
        try:
            document = json.loads(data)
            if document["schema"] != SCHEMA:
                raise ValueError
            slip, owner = _slip_of(document["slip"]), document["of"]
            poses, rests = _poses(document, configuration.n), _rests(document, configuration.n)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
            return f"{path}: found no rests of an arm, ignored; joints' zeros are learned anew"
        self._slip, self._is_new = slip, slip is not None
        if owner != _identity(configuration):
            return f"{path}: found rests with another cell; joints' zeros are learned anew"
        watch.resume(poses, rests)
        self._text = self._document(watch, configuration)
        return ""

    def slip_of_earlier_run(self) -> Event | None:
        """Return the event of a slip that nobody has acknowledged in an earlier run, once."""
        slip, self._is_new = self._slip if self._is_new else None, False
        return slip

    def on_event(self, event: Event) -> None:
        """Note a slip, and that it is acknowledged."""
        if event["kind"] == EventKind.SLIP:
            self._slip = {"kind": EventKind.SLIP, **{key: event[key] for key in SLIP}}
        if event["kind"] == EventKind.REQUEST and event["acknowledges"]:
            self._slip = None

    def step(self, watch: SlipWatch, configuration: Configuration, at_once: bool = False) -> str:
        """Write what is new, once a minute or ``at_once``; returns why it failed, once."""
        if self._path is None or (self._now() < self._due and not at_once):
            return ""
        if self._writing is not None and self._writing.is_alive():
            self._due = self._now()  # what is new is written after it
            return ""
        problem = self._problem()
        self._due = self._now() + EVERY
        text = self._document(watch, configuration)
        if text != self._text:
            self._text, self._writing = text, _Write(self._path, text)
            try:
                self._writing.start()
            except RuntimeError:  # no thread can be started
                self._text, self._writing = "", None  # tried again
        return problem

    def finish(self) -> str:
        """Wait for a write that is under way; returns why what it writes is lost, once."""
        if self._writing is None:
            return ""
        self._writing.join(self._longest_wait)
        return self._problem()

    def _problem(self) -> str:
        if self._writing is None or not (what := self._writing.problem):
            return ""
        self._text = ""  # tried again
        if self._failed:
            return ""
        self._failed = True
        return f"what was learned of the joints' zeros is lost at the end: {what}"

    def _document(self, watch: SlipWatch, configuration: Configuration) -> str:
        """Return the file's text; before enough is learned there are no rests in it."""
        places, rests = (watch.places, watch.rests) if watch.learned else ((), ())
        document = {
            "schema": SCHEMA,
            "of": _identity(configuration),
            "slip": self._slip,
            "poses": [
                {"q": place.q.tolist(), "mass": place.mass, "cog": place.cog.tolist(),
                 "side": np.frombuffer(place.side, np.int8).tolist()}
                for place in places
            ],
            "rests": [
                [rest.place, rest.time, [_number(reading) for reading in rest.readings]]
                for rest in rests
            ],
        }  # fmt: skip
        return json.dumps(document, separators=(",", ":")) + "\n"


class _Write(threading.Thread):
    """A write that nobody has to wait for, not even the end of the process."""

    def __init__(self, path: Path, text: str) -> None:
        super().__init__(name="rests", daemon=True)
        self._path, self._text = path, text
        self.problem = f"{path}: the file system does not answer"  # until it has

    def run(self) -> None:
        """See threading.Thread."""
        try:
            write_text(self._path, self._text)
            self.problem = ""
        except Exception as error:  # whatever it is, the daemon goes on
            is_own = isinstance(error, GapbridgeError)
            self.problem = str(error) if is_own else type(error).__name__


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _identity(configuration: Configuration) -> str:
    """Return what rests belong to: the cell, its files, and the program that predicts readings."""
    return f"{installed_version()} {configuration.fingerprint}"


def _slip_of(kept: Any) -> Event | None:
    if kept is None:
        return None
    event = {"kind": EventKind.SLIP, **{key: kept[key] for key in SLIP}}
    if not isinstance(event["detail"], str):
        raise ValueError
    return event


def _numbers(values: Any, count: int) -> Array:
    """Return (count,) finite numbers, None as NaN. Raises ValueError, TypeError."""
    numbers = np.array([np.nan if value is None else float(value) for value in values])
    if numbers.shape != (count,) or np.any(np.abs(numbers) > LARGEST):
        raise ValueError
    return numbers


def _finite(values: Any, count: int) -> Array:
    numbers = _numbers(values, count)
    if not np.isfinite(numbers).all():
        raise ValueError
    return numbers


def _poses(document: dict[str, Any], n: int) -> list[tuple[Array, float, Array, bytes]]:
    poses = [
        (
            _finite(pose["q"], n), float(_finite([pose["mass"]], 1)[0]), _finite(pose["cog"], 3),
            np.sign(_finite(pose["side"], n)).astype(np.int8).tobytes(),
        )
        for pose in document["poses"]
    ]  # fmt: skip
    if len(poses) > MAX_POSES:
        raise ValueError
    return poses


def _rests(document: dict[str, Any], n: int) -> list[Rest]:
    count = len(document["poses"])
    rests = [
        Rest(int(place), float(time), _numbers(readings, 6 + n))
        for place, time, readings in document["rests"]
    ]
    if len(rests) > MAX_RESTS or not all(0 <= rest.place < count for rest in rests):
        raise ValueError
    return rests
