"""Whether friction beyond Coulomb's and viscous differs by direction in real torque logs.

    python -m benchmarks.real.friction_by_direction LOG_FOLDER...

Plain least squares (``rivals``: base parameters, Coulomb, viscous and constant friction, rotors),
with one term a joint more: |qd| is viscous friction that differs by direction (a constant that
does is in the base fit: the torque's offset), qd |qd| a curve that does not. Five folds, each a
stretch of the log; rms over all folds and joints, and each added value in the five fits.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.real import rivals
from benchmarks.real.table import read_cell, read_table

Array = NDArray[np.float64]
FOLDS = 5
TERMS: dict[str, Callable[[Array], Array]] = {
    "none": lambda qd: qd[:, :0],
    "|qd|": np.abs,
    "qd |qd|": lambda qd: qd * np.abs(qd),
}


def judged(folder: Path) -> list[str]:
    """Return a line for each term of one log."""
    cell, table = read_cell(folder / "cell.yaml"), read_table(folder / "log.csv")
    model = rivals.pinocchio_model(cell, folder, pin)
    n = model.nv
    A, b = rivals.torque_rows(model, pin, table, 1)
    qd = rivals.derivatives(table)[1]
    edge = (len(qd) - len(b) // n) // 2
    qd = qd[edge : len(qd) - edge]
    fold = np.arange(len(qd)) * FOLDS // len(qd)
    lines, first = [], 0.0
    for name, term in TERMS.items():
        added = np.vstack([np.diag(v) if len(v) else np.zeros((n, 0)) for v in term(qd)])
        whole, left, values = np.hstack([A, added]), np.zeros_like(qd), []
        for k in range(FOLDS):
            row = np.repeat(fold == k, n)
            step = np.repeat(np.arange(len(qd)) % max(1, len(qd) // rivals.MOST) == 0, n)
            x = rivals.solved(whole[~row & step], b[~row & step], n)
            left[fold == k] = (b[row] - whole[row] @ x).reshape(-1, n)
            values.append(x[A.shape[1] :])
        rms = float(np.sqrt(np.mean(left**2)))
        first = first or rms
        spread = zip(np.mean(values, axis=0), np.std(values, axis=0), strict=True)
        sizes = ", ".join(f"{mean:.3g} ± {std:.2g}" for mean, std in spread)
        lines.append(f"{folder.name} {name}: {rms:.4g} Nm ({rms / first:.3f}) {sizes}")
    return lines


def main() -> None:
    """Print the lines of every log."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    for folder in parser.parse_args().folders:
        print("\n".join(judged(folder)), flush=True)


if __name__ == "__main__":
    main()
