"""What the paper leaves as future work: many poses, payloads and pulls, an instrument's noise.

50 poses to fit, 50 others to check, each with its own payload and pull; truth: finite elements;
noise of 20 um (1 sigma of one coordinate) on every measured position. Prints the error of the
predicted positions on the poses that the fit did not see.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.evidence.finite_elements import STIFF, Frame, FrameArm, NodalLoad
from benchmarks.evidence.paper import TUBE, frame_arm, rigid_model
from gapbridge.core.estimation.identification import Identification, identify_compliance
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.rotation import rotation_matrix

POSES = 50
NOISE = 2e-5  # m
COG = np.array([0.01, -0.02, 0.06])


def measured(arm: FrameArm, rng: np.random.Generator, name: str) -> dict[str, np.ndarray]:
    """Return the columns of a log whose positions finite elements give, without noise."""
    count, n = 2 * POSES, len(arm.dh)
    q = rng.uniform(-2, 2, (count, n))
    mass = rng.uniform(0, 8, count)
    wrench = rng.uniform(-1, 1, (count, 6)) * np.array([60, 60, 60, 6, 6, 6])
    moved = [
        Frame(arm, q[r], COG).deflection([NodalLoad(wrench[r], mass[r], COG)])[0]
        for r in range(count)
    ]
    rigid = rigid_model(name).rigid_pose(q).position
    return {
        "actual_q": q,
        "payload": mass,
        "payload_cog": np.tile(COG, (count, 1)),
        "actual_TCP_force": wrench,
        "measured_position": rigid + np.array(moved)[:, :3],
    }


def rms(gap: np.ndarray) -> float:
    return float(np.sqrt(np.mean(gap**2)))


def emit(name: str, columns: dict[str, np.ndarray], seed: int, registered: bool) -> Identification:
    """Fit on the first half, print how the second is met, in um a coordinate."""
    rng = np.random.default_rng([seed, 1])
    true = columns["measured_position"]
    noisy = true + rng.normal(size=true.shape) * NOISE
    turn, shift = np.eye(3), np.zeros(3)
    if not registered:
        turn, shift = rotation_matrix(rng.normal(size=3)), rng.normal(size=3)
    given = columns | {"measured_position": noisy @ turn.T + shift}
    model = rigid_model(name)
    log = Log("poses", {k: v[:POSES] for k, v in given.items()}, model.arm.n)
    found = identify_compliance(model, log, Metrology(registered=registered, sigma=NOISE))
    fresh = slice(POSES, None)
    loads = Loads(columns["payload"], columns["payload_cog"], columns["actual_TCP_force"])[fresh]
    predicted = found.model.predict(columns["actual_q"][fresh], loads).position
    rigid = model.rigid_pose(columns["actual_q"][fresh]).position
    against = found.registration.in_base(given["measured_position"][fresh])
    frame = "known" if registered else "fitted"
    print(f"  frame {frame:7s} {1e6 * rms(true[fresh] - rigid):9.1f} "
          f"{1e6 * rms(against - predicted):9.2f} {rms(against - predicted) / NOISE:9.3f} "
          f"{1e6 * rms(true[fresh] - predicted):11.2f}")  # fmt: skip
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    seeds = parser.parse_args().seeds
    print(f"{POSES} poses fitted, {POSES} others checked; noise {NOISE * 1e6:.0f} um; rms of one "
          "coordinate, um")  # fmt: skip
    head = "rigid arm   checked   / noise  to the truth"
    for links, what in ((STIFF, "rigid links"), (TUBE, "flexible links (EI 2e5 N m2)")):
        for name in ("ur10e", "seven"):
            print(f"\n{name}, {what:32s}\n{'':15s}{head}")
            for seed in range(1, seeds + 1):
                rng = np.random.default_rng(seed)
                columns = measured(frame_arm(name, rng, links), rng, name)
                for registered in (True, False):
                    emit(name, columns, seed, registered)


if __name__ == "__main__":
    main()
