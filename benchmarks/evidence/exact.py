"""The exact prediction against the bends solved as one system of equations by MINPACK."""

from __future__ import annotations

import argparse
import sys

import numpy as np

from benchmarks.evidence import ROOT

sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "core")]  # the oracle stands with the tests


def main() -> None:
    from test_equilibrium import ARMS, compare

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=2)
    options = parser.parse_args()
    position, turn = compare(options.cases, options.seed)
    print(f"{options.cases} random poses, loads and compliances of {', '.join(ARMS)}: largest "
          f"difference {np.max(position):.1e} m, {np.max(turn):.1e} in the rotation")  # fmt: skip


if __name__ == "__main__":
    main()
