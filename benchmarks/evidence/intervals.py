"""Do 95 % intervals hold the truth where joints are read coarsely, at repeated poses.

``python -m benchmarks.evidence.intervals --seeds 20``. A simulated UR10e (rotations of its own,
loads in the deflected shape) whose flexibilities, tool point and zeros are drawn; 36 poses under
three loads each. Joints are read exactly, or with the same rounding at every repeat of a pose.
``fit`` on an arm that is as drawn; ``diagnose`` of the cell that ``fit`` wrote, on an arm with a
bent tool and a zero that is off; ``calibrate`` all of it at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import click
import numpy as np

from gapbridge.core.arm import builtin_arm
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.fit import fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.diagnosis.diagnosis import channels_of, diagnose
from gapbridge.core.estimation.identification import Identification, identify_compliance
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.drivers.simulated.plant.plant import Load, Plant
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import draw_plant_settings

ARM = "ur10e"
POSES, LOADS = 36, 3
NOISE = 2e-5  # m, 1 sigma of one coordinate of the instrument
COUNTS = {"exact": 0.0, "0.1 mrad": 1e-4, "1 mrad": 1e-3}  # rad, of what the encoders say
KNOWN = Metrology(registered=True, sigma=NOISE)
FITTED = ("tool_frame", "joint_offset", "axial_compliance", "radial_compliance")
INSIDE = 1.96
Truth = dict[str, float]  # by the names of reports, SI
Held = tuple[str, str, float]  # command, effect, error in sigmas


def measured(seed: int, count: float, hidden: bool) -> tuple[Log, Truth]:
    """Return a log, and what is true of its arm beyond the rigid nominal one."""
    rng = np.random.default_rng((seed, 3))
    settings = draw_plant_settings(plant_arm(ARM), seed)
    shift, zero = rng.normal(0, 1e-3, 3) * hidden, rng.normal(0, 1e-3) * hidden
    settings = replace(settings, tool_shift=tuple(shift), zero=(0.0, 0.0, float(zero), 0, 0, 0))
    q = rng.uniform(-2.0, 2.0, (POSES, 6))
    plant = Plant(plant_arm(ARM), settings, q[0])
    rows: list[tuple[Array | float, ...]] = []
    for pose in q:
        for mass in rng.uniform(0.0, 10.0, LOADS):
            pull = rng.normal(0, [30.0, 30.0, 30.0, 3.0, 3.0, 3.0])
            cog = rng.uniform(-0.05, 0.1, 3)
            plant.load = Load(float(mass), tuple(cog), tuple(pull[:3]), tuple(pull[3:]))
            plant.q, plant.scatter = tuple(pose), plant._draw_scatter()
            read = np.round(pose / count) * count if count else pose
            position = np.array(plant.true_tcp().origin) + rng.normal(0, NOISE, 3)
            rows.append((read, mass, cog, pull, position))
    names = "actual_q", "payload", "payload_cog", "actual_TCP_force", "measured_position"
    columns = {
        name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    truth = {f"tool_frame_{axis}": float(v) for axis, v in zip("xyz", shift, strict=True)}
    truth["joint_offset_3"] = float(zero)
    for kind, values in (("axial", settings.axial), ("radial", settings.radial)):
        truth |= {f"{kind}_compliance_{i + 1}": v for i, v in enumerate(values)}
    return Log("simulated", columns, 6), truth


def fitted(found: Identification, truth: Truth) -> Iterator[Held]:
    """Yield the errors of a fit's flexibilities."""
    spread = Spread.of_fit(found.identifiable, found.covariance)
    values = np.concatenate([found.axial, found.radial])[found.identifiable]
    sigma = np.sqrt(np.diag(spread.covariance))
    for name, value, own in zip(spread.names, values, sigma, strict=True):
        yield "fit", name.rpartition("_")[0], float((value - truth[name]) / own)


def diagnosed(model: Model, found: Identification, log: Log, truth: Truth) -> Iterator[Held]:
    """Yield the errors of what a diagnosis of the fitted cell accuses."""
    cell = model.with_compliance(found.axial, found.radial)
    spread = Spread.of_fit(found.identifiable, found.covariance)
    uncertain = partial(spread.sigma_columns, cell)
    there = dict(zip(spread.names, np.concatenate([found.axial, found.radial])[
        found.identifiable], strict=True))  # fmt: skip
    for channel in diagnose(cell, log, KNOWN, observers=channels_of(uncertain)).channels:
        for cause in channel.causes:
            for p in cause.parameters:
                if p.name in truth:  # positions alone do not show how the tool is turned
                    true = truth[p.name] - there.get(p.name, 0.0)
                    yield "diagnose", cause.effect, float((p.value - true) / (p.std or np.inf))


def calibrated(model: Model, log: Log, truth: Truth) -> Iterator[Held]:
    """Yield the errors of a calibration."""
    count = len(log)
    zeros, none = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool)
    readings = Readings(
        "position", log.columns["actual_q"], log.columns["measured_position"],
        np.full(count, np.nan), log.loads(), zeros, zeros, zeros, none,
        np.repeat(np.arange(POSES), LOADS),
    )  # fmt: skip
    how = make_observable(readings.kind, registered=True)
    parameters = identifiable_parameters(model, FITTED, observable=how, pulls=True)
    for e in fit_session(readings, parameters, KNOWN).estimates():
        if e.shown:
            effect = next(name for name in FITTED if e.name.startswith(name))
            yield "calibrate", effect, float((e.value - truth.get(e.name, 0.0)) / e.std)


@click.command()
@click.option("--seeds", default=20, show_default=True, help="Arms for each case.")
@click.option("--seed", default=0, show_default=True, help="First seed.")
def main(seeds: int, seed: int) -> None:
    """Print how many 95 % intervals hold the truth, by command, effect and how joints are read."""
    model = Model(builtin_arm(ARM), np.eye(4))
    for name, count in COUNTS.items():
        held: list[Held] = []
        for k in range(seed, seed + seeds):
            log, truth = measured(k, count, hidden=False)
            held += fitted(identify_compliance(model, log, KNOWN), truth)
            log, truth = measured(k, count, hidden=True)
            held += diagnosed(model, identify_compliance(model, log, KNOWN), log, truth)
            held += calibrated(model, log, truth)
        for command in ("fit", "diagnose", "calibrate"):
            for effect in dict.fromkeys(e for c, e, _ in held if c == command):
                z = np.array([z for c, e, z in held if (c, e) == (command, effect)])
                share = np.mean(np.abs(z) < INSIDE)
                click.echo(f"joints {name}: {command} {effect}: {share:.1%} of {len(z)}, "
                           f"rms of error over sigma {np.sqrt(np.mean(z**2)):.2f}")  # fmt: skip
            z = np.array([z for c, _, z in held if c == command])
            if len(z):
                share = np.mean(np.abs(z) < INSIDE)
                click.echo(f"joints {name}: {command}: {share:.1%} of {len(z)}")


if __name__ == "__main__":
    main()
