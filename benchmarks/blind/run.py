"""Runs the blind benchmark: draw a case, have it diagnosed, score it, forget it."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.blind.cases import kinds, make_case
from benchmarks.blind.score import CaseScore, failed, score
from benchmarks.blind.sensitivity import Sensitivity, sensitivity

Diagnose = Callable[[Path, Path, tuple[str, ...]], dict[str, Any]]
LIMIT = 120.0  # s, of one diagnosis; longer is a failed case
CLEAN_FACTOR = 10  # clean cases of the position channel: this many times the seeds of the others


class DiagnosisError(RuntimeError):
    """Raised where a diagnosis ends without an answer."""


@dataclass(frozen=True)
class Command:
    """A diagnosis by a program of its own: ``COMMAND LOG --cell CELL --json FILE``."""

    command: tuple[str, ...] = ("gapbridge", "diagnose")
    timeout: float = LIMIT

    @classmethod
    def parse(cls, text: str) -> Command:
        """Return the command of a line as one would type it.

        A ``gapbridge`` beside the running interpreter goes before one on the path: nobody has to
        activate the environment.
        """
        first, *others = shlex.split(text)
        own = Path(sys.executable).parent / first
        return cls((str(own) if own.is_file() and os.sep not in first else first, *others))

    def __call__(self, log: Path, cell: Path, withhold: tuple[str, ...]) -> dict[str, Any]:
        """Return the diagnosis' JSON; raises DiagnosisError with what the program said."""
        with tempfile.TemporaryDirectory(prefix="gapbridge-") as folder:
            file = Path(folder) / "diagnosis.json"
            command = [*self.command, str(log), "--cell", str(cell), "--json", str(file)]
            for effect in withhold:
                command += ["--withhold", effect]
            try:
                done = subprocess.run(
                    command, capture_output=True, text=True, timeout=self.timeout, check=False
                )
            except subprocess.TimeoutExpired:
                raise DiagnosisError(f"no answer in {self.timeout:g} s") from None
            except OSError as error:
                raise DiagnosisError(f"{self.command[0]}: {error}") from None
            if done.returncode != 0 or not file.exists():
                output = (done.stderr.strip() or done.stdout.strip()).splitlines()
                raise DiagnosisError(
                    f"exit {done.returncode}: {output[-1] if output else 'silent'}"
                )
            answer: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
            return answer


@dataclass(frozen=True)
class Job:
    """One case to run."""

    kind: str
    seed: int


def fresh_seed() -> int:
    """Return a seed from the system's own randomness."""
    return int.from_bytes(os.urandom(4), "big")


def chosen_kinds(names: Iterable[str] | None) -> tuple[str, ...]:
    """Return kinds by their names or their groups' names; all where none are given."""
    table = kinds()
    if names is None:
        return tuple(k for own in table.values() for k in own)
    out: list[str] = []
    for name in names:
        out += table.get(name, (name,))
    return tuple(dict.fromkeys(out))


def jobs_of(chosen: Sequence[str], seeds: int, first_seed: int) -> list[Job]:
    """Return the cases to run; clean ones of the position channel in larger number."""
    jobs = []
    for kind in chosen:
        count = seeds * CLEAN_FACTOR if kind == "none" else seeds
        jobs += [Job(kind, first_seed + k) for k in range(count)]
    return jobs


@contextmanager
def _at_most(seconds: float) -> Iterator[None]:
    """Raise DiagnosisError in what runs longer; no limit where signals are not to be had."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGALRM"):
        yield
        return

    def stop(number: int, frame: object) -> None:
        raise DiagnosisError(f"no answer in {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def run_job(job: Job, diagnose: Diagnose, keep: Path | None = None) -> CaseScore:
    """Run one case. Its folder's name gives nothing away; its label stays in this process."""
    with tempfile.TemporaryDirectory(prefix="case-") as scratch:
        folder = Path(scratch)
        label = make_case(job.kind, job.seed, folder)
        start = time.perf_counter()
        try:
            with _at_most(LIMIT):
                answer = diagnose(folder / "log.csv", folder / "cell.yaml", label.withhold)
        except Exception as error:
            output = f"{type(error).__name__}: {error}"
            return failed(label, output, time.perf_counter() - start)
        seconds = time.perf_counter() - start
    if keep is not None:
        name = f"{job.kind.replace(':', '_')}-{job.seed}.json"
        (keep / name).write_text(json.dumps(answer, indent=1), encoding="utf-8")
    try:
        return score(label, answer, seconds)
    except (KeyError, TypeError, ValueError) as error:
        return failed(label, f"the JSON breaks the contract: {error!r}", seconds)


def run_blind(
    seeds: int = 20,
    kinds: Iterable[str] | None = None,
    workers: int = 1,
    out: Path | None = None,
    diagnose: Diagnose | None = None,
    first_seed: int | None = None,
) -> Iterator[CaseScore]:
    """Yield scores as they come. ``out`` keeps the diagnoses' JSON; seeds are fresh by default.

    Raises ValueError where a kind is unknown.
    """
    chosen = chosen_kinds(kinds)
    known = {k for own in _all_kinds().values() for k in own}
    for kind in chosen:
        if kind not in known and "+" not in kind and not kind.startswith("size:"):
            raise ValueError(f"kind: found {kind!r}, expected a kind or group that --list shows")
    if not has_pinocchio():
        chosen = tuple(k for k in chosen if "torque:" not in k)
    first = fresh_seed() if first_seed is None else first_seed
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    jobs = jobs_of(chosen, seeds, first)
    how: Diagnose = diagnose or Command()
    if workers <= 1:
        for job in jobs:
            yield run_job(job, how, out)
        return
    with ProcessPoolExecutor(workers, initializer=_one_thread) as pool:
        waiting = [pool.submit(run_job, job, how, out) for job in jobs]
        for done in as_completed(waiting):
            yield done.result()


def run_sensitivity(
    effects: Sequence[str], seeds: Sequence[int], workers: int, diagnose: Diagnose
) -> list[Sensitivity]:
    """Return how small each effect may be and still be found."""
    run = functools.partial(_run_one, diagnose)
    if workers <= 1:
        return [sensitivity(e, seeds, run) for e in effects]
    with ProcessPoolExecutor(workers, initializer=_one_thread) as pool:
        return list(pool.map(functools.partial(sensitivity, seeds=seeds, run=run), effects))


def _run_one(diagnose: Diagnose, kind: str, seed: int) -> CaseScore:
    return run_job(Job(kind, seed), diagnose)


def _all_kinds() -> dict[str, tuple[str, ...]]:
    return kinds()


def has_pinocchio() -> bool:
    """Return whether the torque channel's truth can be made here (it needs the test extra)."""
    return importlib.util.find_spec("pinocchio") is not None


def _one_thread() -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
