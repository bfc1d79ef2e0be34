"""The daemon's watch over the joints' zeros: what it misses, and how often it is wrong.

    python -m benchmarks.zero_slips [--hours 20] [--slips 60]

A program of six poses drawn by chance, one rest of a second at each. What the flange sensor and the
motors read comes from the simulated plant's own code, which shares nothing with the model. On top:
noise of each sample, motors that hold another share of their friction at each rest (0.5 Nm: the
currents of a UR3e that ran one program three times, public, differ by 0.05 to 0.09 A of some 11
Nm/A), zeros of sensor and motors that wander (2.4 N, 5 Nm in an hour), and hands on the arm.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.daemon.slip_watch import SlipWatch
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.core.arm import builtin_arm
from gapbridge.core.model import Model
from gapbridge.drivers.simulated.plant.kinematics import holding_torque
from gapbridge.drivers.simulated.plant.plant import Plant
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import draw_plant_settings

Array = NDArray[np.float64]
RATE = 20.0  # Hz of the rows; their noise is that of 500 Hz, averaged
REST, MOVE = 20, 12  # rows
FRICTION = 0.5  # Nm, 1 sigma of what a motor holds otherwise from rest to rest
WANDER = (0.05, 0.003, 0.1)  # N, Nm, Nm from rest to rest
COUNTS = 6  # poses of the program
SLICES = slices_of(6)
WIDTH = max(part.stop for part in SLICES.values())
COG = (0.02, 0.01, 0.06)


@dataclass(frozen=True)
class Setup:
    """An arm, what it carries, and what it can measure."""

    name: str
    arm: str
    payload: float  # kg
    sensor: bool  # a flange sensor
    motors: bool  # joint torques


SETUPS = (
    Setup("UR10e, 5 kg", "ur10e", 5.0, True, True),
    Setup("UR10e, 5 kg, flange sensor alone", "ur10e", 5.0, True, False),
    Setup("UR10e, 5 kg, motors alone", "ur10e", 5.0, False, True),
    Setup("UR3e, 1 kg", "ur3e", 1.0, True, True),
)


class Program:
    """Rests of an arm that goes round its poses; ``seed`` draws the poses and all noise."""

    def __init__(self, setup: Setup, seed: int) -> None:
        self._setup, self._rng = setup, np.random.default_rng((seed, 41))
        home = np.array([0.0, -1.2, 1.4, -1.3, -1.4, 0.2])
        self.poses = home + self._rng.uniform(-0.7, 0.7, (COUNTS, 6))
        self.zero, self._more = np.zeros(6), 0.0
        self._truth = [self._readings(q) for q in self.poses]
        self._drift = np.zeros(12)
        self.time, self._number = 0.0, 0
        self.model = Model(builtin_arm(setup.arm))

    def slip(self, joint: int, size: float) -> None:
        """Have the zero of a joint (from 0) slip by ``size`` rad."""
        self.zero[joint] += size
        self._truth = [self._readings(q) for q in self.poses]

    def load(self, more: float) -> None:
        """Hang ``more`` kg on the flange, and declare nothing."""
        self._more += more
        self._truth = [self._readings(q) for q in self.poses]

    def _readings(self, q: Array) -> Array:
        """Return what a perfect flange sensor and perfect motors read (12,) at rest."""
        arm, mass = plant_arm(builtin_arm(self._setup.arm)), self._setup.payload + self._more
        settings = replace(
            draw_plant_settings(arm, 3), payload_mass=mass, payload_cog=COG,
            zero=tuple(self.zero), joint_scatter=(0.0,) * 6,
        )  # fmt: skip
        plant = Plant(arm, settings, tuple(q))
        angles = plant.true_angles()
        turned = np.reshape(plant.shape(angles).frames[-1].rotation, (3, 3)).T
        force = turned @ (mass * np.array(settings.gravity))
        torque = holding_torque(arm, angles, settings.gravity, mass, COG, (0.0,) * 6, plant.tool)
        return np.concatenate([force, np.cross(COG, force), torque])

    def rests(self, count: int, touched: float = 0.0) -> Iterator[tuple[Array, bool]]:
        """Yield the rows of the way to each of ``count`` rests, and of the rest.

        ``touched``: share of the rests at which a person holds the arm, for a part of it or all.
        """
        rng, setup = self._rng, self._setup
        for _ in range(count):
            here = self._number % COUNTS
            before = self.poses[here - 1]
            self._number += 1
            s = np.linspace(0.0, 1.0, MOVE)[:, None]
            way = before + (self.poses[here] - before) * s * s * (3.0 - 2.0 * s)
            rows = np.full((MOVE + REST, WIDTH), np.nan)
            rows[:, SLICES["timestamp"].start] = self.time + np.arange(len(rows)) / RATE
            rows[:, SLICES["actual_q"]] = np.vstack([way, np.tile(self.poses[here], (REST, 1))])
            self._drift += rng.normal(size=12) * np.repeat(WANDER, (3, 3, 6))
            read = self._truth[here] + self._drift
            read[6:] += rng.normal(size=6) * FRICTION
            noise = rng.normal(size=(len(rows), 12)) * np.repeat((0.25, 0.02, 0.3), (3, 3, 6))
            read = read + noise / np.sqrt(500.0 / RATE)
            hand = rng.random() < touched
            if hand:
                begin = MOVE + int(rng.integers(REST))
                way_of_hand = rng.normal(size=3)
                size = np.exp(rng.uniform(np.log(2.0), np.log(40.0)))
                read[begin : begin + int(rng.integers(4, REST)), :3] += (
                    size * way_of_hand / np.linalg.norm(way_of_hand)
                )
            if setup.sensor:
                rows[:, SLICES["ft_raw_wrench"]] = read[:, :6]
            if setup.motors:
                rows[:, SLICES["actual_current_as_torque"]] = read[:, 6:]
            rows[:, SLICES["payload"].start] = setup.payload
            rows[:, SLICES["payload_cog"]] = COG
            self.time += len(rows) / RATE
            yield rows, hand


def found_in(
    watch: SlipWatch, program: Program, count: int, touched: float = 0.0
) -> tuple[list[Event], list[Event], int]:
    """Return the slips and forces found in ``count`` rests, and how many rests had a hand on."""
    found: list[Event] = []
    hands = 0
    for rows, hand in program.rests(count, touched):
        hands += hand
        for row in rows:
            found += watch.take(row[None])
    slips = [event for event in found if event["kind"] == EventKind.SLIP]
    return slips, [event for event in found if event["kind"] == EventKind.WARNING], hands


def quiet(setup: Setup, hours: float, touched: float) -> str:
    """Return what was found in hours without a slip, an hour a program."""
    rests = int(3600.0 / ((MOVE + REST) / RATE))
    slips = forces = hands = 0
    for seed in range(int(hours)):
        program = Program(setup, 1000 + seed)
        watch = SlipWatch(program.model, SLICES, 0.003)
        one = found_in(watch, program, rests, touched)
        slips, forces, hands = slips + len(one[0]), forces + len(one[1]), hands + one[2]
    return f"{slips} slips, {forces} forces ({hands} hands) in {hours:g} h"


def slipped(setup: Setup, size: float, count: int) -> str:
    """Return the share found of ``count`` slips of joints 2 to 6, when, and how well."""
    rests, right, deviations = [], 0, []
    for seed in range(count):
        program, joint = Program(setup, seed), 1 + seed % 5
        watch = SlipWatch(program.model, SLICES, 0.003)
        if found_in(watch, program, 6 * COUNTS + seed % COUNTS)[0]:
            continue
        sign = 1.0 if seed % 2 else -1.0
        program.slip(joint, sign * size)
        for number in range(1, 8 * COUNTS + 1):
            slips, _, _ = found_in(watch, program, 1)
            if slips:
                rests.append(number)
                right += joint + 1 in slips[0]["joints"]
                if slips[0]["joints"][0] == joint + 1:
                    deviations.append((slips[0]["size"] - sign * size) / slips[0]["std"])
                break
    if not rests:
        return f"0 of {count}"
    z = float(np.sqrt(np.mean(np.square(deviations)))) if deviations else float("nan")
    return (
        f"{len(rests)} of {count}, after {np.median(rests):.0f} rests (9 in 10: "
        f"{np.quantile(rests, 0.9):.0f}), joint among those named {right}, error/sigma {z:.1f}"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=20.0)
    parser.add_argument("--slips", type=int, default=60)
    given = parser.parse_args()
    for setup in SETUPS:
        print(f"{setup.name}")
        print(f"  quiet: {quiet(setup, given.hours, 0.0)}", flush=True)
        print(f"  hands: {quiet(setup, given.hours / 2, 0.02)}", flush=True)
        for size in (0.005, 0.010, 0.020, 0.040):
            found = slipped(setup, size, given.slips)
            print(f"  slip of {1e3 * size:.0f} mrad: {found}", flush=True)


if __name__ == "__main__":
    main()
