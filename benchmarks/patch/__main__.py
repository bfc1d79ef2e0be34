"""Every effect that an MJCF can hold, round the loop: ``python -m benchmarks.patch``."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from benchmarks.patch.arms import written_arms
from benchmarks.patch.cases import cases
from benchmarks.patch.measured import SETS, compared
from benchmarks.patch.measured import line as line_of_set
from benchmarks.patch.run import run
from benchmarks.patch.table import draw, fill_page, line


def main() -> None:
    """Run the chosen cases, print a line for each, write the figures as JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.patch",
        description="An effect in a MuJoCo model: named, patched, simulated again.",
        epilog="example: python -m benchmarks.patch --effects latency,backlash --arms ur10e",
    )
    arms = written_arms()
    parser.add_argument("--effects", default="", help="only these, with commas between")
    parser.add_argument("--arms", default=",".join(arms))
    parser.add_argument("--out", type=Path, default=Path("out/patch"))
    parser.add_argument("--resume", action="store_true", help="keep results that are there")
    parser.add_argument("--page", action="store_true", help="fill docs/simulators.md, and draw")
    parser.add_argument(
        "--urdf", action="store_true", help="instead: measured arms into URDF (../shared/data)"
    )
    given = parser.parse_args()
    if given.urdf:
        for name in SETS:
            print(line_of_set(compared(name, given.out / "urdf" / name)), flush=True)
        return
    results = []
    for name in given.arms.split(","):
        for case in cases(arms[name]):
            if given.effects and case.effect not in given.effects.split(","):
                continue
            folder = given.out / name / case.effect
            file = folder / "result.json"
            if not (given.resume and file.is_file()):
                begin = time.perf_counter()
                try:
                    found = run(arms[name], case, folder)
                except (RuntimeError, AssertionError) as error:
                    found = {"arm": name, "effect": case.effect, "error": str(error)}
                found["seconds"] = round(time.perf_counter() - begin, 1)
                file.write_text(json.dumps(found, indent=1) + "\n")
            results.append(json.loads(file.read_text()))
            print(line(results[-1]), flush=True)
    (given.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    if given.page:
        fill_page(Path("docs/simulators.md"), results)
        draw(Path("docs/images/patch.svg"), results)


if __name__ == "__main__":
    main()
