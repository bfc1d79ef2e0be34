"""``python -m benchmarks.simulation --seeds 100000``; one seed again: ``--seed 1234``."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path

from benchmarks.simulation.sequence import LINKS, Outcome, run

REPORT_EVERY = 60.0  # s


def main() -> int:
    """Run seeds one after the other; returns 1 where an invariant did not hold."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=2000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--seed", type=int, help="one seed, with all its events")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no seed after")
    parser.add_argument("--out", type=Path, help="JSON file of figures")
    given = parser.parse_args()
    if given.seed is not None:
        outcome = run(given.seed, print)
        print(outcome)
        return int(bool(outcome.violations))
    return many(given.first, given.seeds, 60.0 * given.minutes, given.out)


def many(first: int, count: int, limit: float, out: Path | None) -> int:
    """Run many seeds, and print what they came to."""
    begun, reported = time.monotonic(), time.monotonic()
    done: Counter[str] = Counter()
    faults = writes = violated = 0
    oldest, simulated = dict.fromkeys(LINKS, 0.0), 0.0
    for seed in range(first, first + count):
        if time.monotonic() - begun > limit:
            break
        outcome: Outcome = run(seed)
        done[outcome.link] += 1
        faults, writes = faults + len(outcome.faults), writes + outcome.writes
        oldest[outcome.link] = max(oldest[outcome.link], outcome.oldest)
        simulated += outcome.seconds
        if outcome.violations:
            violated += 1
            print(f"{outcome}\n  again: python -m benchmarks.simulation --seed {seed}", flush=True)
        if time.monotonic() - reported > REPORT_EVERY:
            reported = time.monotonic()
            print(
                f"{done.total()} seeds, {violated} violated, {reported - begun:.0f} s", flush=True
            )
    figures = {
        "first": first, "seeds": done.total(), "by_link": dict(done), "faults": faults,
        "setpoints": writes, "violated": violated, "oldest_state_s": oldest,
        "simulated_s": simulated, "took_s": time.monotonic() - begun,
    }  # fmt: skip
    print(json.dumps(figures))
    if out is not None:
        out.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return int(violated > 0)


if __name__ == "__main__":
    sys.exit(main())
