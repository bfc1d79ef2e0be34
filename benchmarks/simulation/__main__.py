"""``python -m benchmarks.simulation --seeds 100000``; one seed again: ``--seed 1234``.

Seeds run on all cores. What each hundred of them came to is a line of ``--out``, with a hash of
the sources that run: the same command again, with the same sources, goes on where it was left.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import logging
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.simulation.sequence import LINKS, run

ROOT = Path(__file__).parents[2]
FOLDERS = ("core", "drivers", "bridge", "gapbridge", "benchmarks")
RECORD = Path("out/simulation.jsonl")
PART = 100  # seeds, of a line
PARTS = 20  # until a process is begun anew, with 160 KB left over from each seed
REPORT_EVERY = 60.0  # s
Part = dict[str, Any]


def main() -> int:
    """Run seeds; returns 1 where an invariant did not hold."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=2000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--seed", type=int, help="one seed, with all its events")
    parser.add_argument("--minutes", type=float, default=1e9, help="end then, whatever is left")
    parser.add_argument("--processes", type=int, help="side by side; left out: one a core")
    parser.add_argument("--out", type=Path, default=RECORD, help="the record (%(default)s)")
    given = parser.parse_args()
    logging.disable(logging.WARNING)  # what drivers say of thousands of faults
    if given.seed is not None:
        outcome = run(given.seed, print)
        print(outcome)
        return int(bool(outcome.violations))
    end = given.first + given.seeds
    record = Record(given.out, sources())
    done = [part for part in record.parts if given.first <= part["first"] and part["end"] <= end]
    todo = [*missing(given.first, end, done)]
    report(done)
    begun = reported = time.monotonic()
    before = sum(map(size, done))
    # what was imported is not searched for garbage again; killed processes keep their frames
    with multiprocessing.Pool(given.processes, gc.freeze, maxtasksperchild=PARTS) as pool:
        for part in pool.imap_unordered(run_part, todo):
            record.add(part)
            done.append(part)
            report([part])
            now = time.monotonic()
            if now - reported > REPORT_EVERY:
                reported, count = now, sum(map(size, done))
                left = (now - begun) / (count - before) * (given.seeds - count)
                violated = sum(len(p["violated"]) for p in done)
                print(
                    f"{count} of {given.seeds} seeds, {violated} violated, {left / 60:.0f} min "
                    "left", flush=True,
                )  # fmt: skip
            if now - begun > 60.0 * given.minutes:
                break
    print(json.dumps(figures(done)))
    return int(any(part["violated"] for part in done))


def run_part(seeds: range) -> Part:
    """Run some seeds, and return what they came to."""
    begun, by_link = time.process_time(), Counter[str]()
    faults, oldest = Counter[str](), dict.fromkeys(LINKS, 0.0)
    setpoints, simulated = 0, 0.0
    violated: dict[str, str] = {}
    undetectable: dict[str, float] = {}
    for seed in seeds:
        try:
            outcome = run(seed)
        except Exception as error:  # the simulation's own, not the product's
            raise RuntimeError(f"seed {seed}: {error!r}") from error
        by_link[outcome.link] += 1
        faults.update(words.split(" at ")[0].split(" (")[0] for words in outcome.faults)
        setpoints += outcome.writes
        oldest[outcome.link] = max(oldest[outcome.link], outcome.oldest)
        simulated += outcome.seconds
        if outcome.violations:
            violated[str(seed)] = str(outcome)
        if outcome.hidden:
            undetectable[str(seed)] = outcome.hidden
    return {
        "first": seeds.start, "end": seeds.stop, "by_link": dict(by_link), "faults": dict(faults),
        "setpoints": setpoints, "oldest_state_s": oldest, "simulated_s": simulated,
        "cpu_s": time.process_time() - begun, "violated": violated,
        "undetectable": undetectable,
    }  # fmt: skip


def missing(first: int, end: int, done: Iterable[Part]) -> Iterator[range]:
    """Return the seeds from ``first`` to ``end`` that no part has, in ranges of one part each."""
    known = {seed for part in done for seed in range(part["first"], part["end"])}
    left = [seed for seed in range(first, end) if seed not in known]
    begin = 0
    for i in range(1, len(left) + 1):
        if i == len(left) or left[i] != left[i - 1] + 1 or i - begin == PART:
            yield range(left[begin], left[i - 1] + 1)
            begin = i


def figures(parts: list[Part]) -> dict[str, Any]:
    """Return the sum of parts."""
    by_link, faults = Counter[str](), Counter[str]()
    for part in parts:
        by_link.update(part["by_link"])
        faults.update(part["faults"])
    return {
        "seeds": sum(map(size, parts)), "by_link": dict(by_link),
        "faults": faults.total(), "by_fault": dict(faults.most_common()),
        "setpoints": sum(part["setpoints"] for part in parts),
        "violated": sum(len(part["violated"]) for part in parts),
        "undetectable": {seed: age for part in parts for seed, age in part["undetectable"].items()},
        "oldest_state_s": {
            link: max((part["oldest_state_s"][link] for part in parts), default=0.0)
            for link in LINKS
        },
        "simulated_s": sum(part["simulated_s"] for part in parts),
        "cpu_s": sum(part["cpu_s"] for part in parts),
    }  # fmt: skip


def size(part: Part) -> int:
    """Return how many seeds a part has."""
    return int(part["end"] - part["first"])


def report(parts: Iterable[Part]) -> None:
    """Print what did not hold, and how to run it again."""
    for part in parts:
        for seed, words in part["violated"].items():
            print(f"{words}\n  again: python -m benchmarks.simulation --seed {seed}", flush=True)


class Record:
    """The lines of a file that are of these sources; it is added to."""

    def __init__(self, path: Path, of: str) -> None:
        self._path, self._sources = path, of
        self.parts: list[Part] = []
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            part = json.loads(line)
            if part.get("sources") == of:
                self.parts.append(part)

    def add(self, part: Part) -> None:
        """Write one more line."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        line = json.dumps({"sources": self._sources, **part}) + "\n"
        with open(self._path, "ab") as file:
            file.write(line.encode())


def sources() -> str:
    """Return a hash of the product's and the simulation's modules that this process imported.

    A run imports nothing more, so a commit that changes other files lets what has run count.
    """
    found = hashlib.sha256()
    files = {getattr(module, "__file__", None) for module in sys.modules.values()}
    for file in sorted(Path(name).resolve() for name in files if name):
        inside = file.is_relative_to(ROOT) and file.relative_to(ROOT).parts[0] in FOLDERS
        if inside and file.name != Path(__file__).name:
            found.update(b"%s\n" % str(file.relative_to(ROOT)).encode() + file.read_bytes())
    return found.hexdigest()[:12]


if __name__ == "__main__":
    sys.exit(main())
