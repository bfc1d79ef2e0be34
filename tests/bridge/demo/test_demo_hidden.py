"""The diagnosis names the demo's hidden effects, on data of the simulated plant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from further import further

from gapbridge.bridge.cell import Cell, load_cell, save_cell
from gapbridge.bridge.cell.simulation import _plant
from gapbridge.bridge.demo.hidden import HiddenEffects, NamedCause
from gapbridge.bridge.demo.job import _refit
from gapbridge.bridge.demo.links import LINKS, DemoLink
from gapbridge.bridge.demo.links.can import SOFTNESS
from gapbridge.bridge.demo.measurements import Measurements, joined, write_log
from gapbridge.bridge.demo.poses import plan
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.errors import CellError
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import read_log
from gapbridge.core.rotation import rotation_vector
from gapbridge.drivers.simulated.plant.plant import Load, Plant
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import draw_plant_settings

TRACKER = 5e-6  # m, 1 sigma of the mean of a rest's readings


def plant_of(link: DemoLink) -> Plant:
    """Return the plant that the link serves, built without its server."""
    arm = plant_arm(link.cell.arm)
    settings = replace(draw_plant_settings(arm, link.seed), **_plant(link.cell))
    if link.name == "can":
        settings = replace(
            settings, axial=tuple(SOFTNESS * v for v in settings.axial),
            radial=tuple(SOFTNESS * v for v in settings.radial),
        )  # fmt: skip
    hidden: dict[str, Any] = dict(link.hidden.simulation)
    return Plant(arm, replace(settings, **hidden), link.home)


def measured(link: DemoLink, plant: Plant) -> Measurements:
    """Return the measurements that the demo fits."""
    rng = np.random.default_rng((link.seed, 5))
    experiment, parts = link.experiment, []
    planned = plan(link.cell.model, link.home, link.seed, experiment)
    for load, poses in zip(experiment.calibration_loads, planned.calibration, strict=True):
        plant.load = Load(load.mass, load.cog, load.wrench[:3], load.wrench[3:])
        frames, read = [], []
        for q in poses:
            plant.q, plant.scatter = tuple(q), plant._draw_scatter()
            for _ in range(8):
                plant.q = tuple(plant._drooped_target(q))
            frames.append(plant.true_tcp())
            count = np.radians(0.001) if link.name == "can" else 1e-9  # rad, of what is read
            read.append(np.round(np.array(plant.q) / count) * count)
        rows = load.rows(len(poses))
        parts.append(Measurements(
            np.zeros(len(poses)), poses, np.array(read), rows.payload_mass, rows.payload_cog,
            rows.wrench,
            np.array([f.origin for f in frames]) + rng.normal(0, TRACKER, (len(poses), 3)),
            np.array([rotation_vector(np.reshape(f.rotation, (3, 3))) for f in frames]),
        ))  # fmt: skip
    whole = joined(parts)
    return replace(whole, timestamp=3.0 * np.arange(len(whole)))


def errors(link: DemoLink, plant: Plant, cell: Cell) -> np.ndarray:
    """Return the model's distance (m) from the plant over the demo's test poses."""
    experiment, found = link.experiment, []
    planned = plan(link.cell.model, link.home, link.seed, experiment)
    plant.scatter = (0.0,) * len(plant.q)
    for load, poses in zip(experiment.test_loads, planned.test, strict=True):
        plant.load = Load(load.mass, load.cog, load.wrench[:3], load.wrench[3:])
        expected = cell.model.predict(poses, load.rows(len(poses))).position
        for q, position in zip(poses, expected, strict=True):
            plant.q = tuple(q)
            found.append(np.linalg.norm(position - plant.true_tcp().origin))
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("ur_rtde", 5),
        *further(("can", 3), ("modbus", 3)),
        *further(*((name, seed) for name in sorted(LINKS) for seed in range(4, 10))),
    ],
)
def test_what_is_hidden_is_named_on_every_link(tmp_path: Path, name: str, seed: int) -> None:
    mismatches, alone, both = judged(LINKS[name](tmp_path, seed), tmp_path)
    assert mismatches == []
    assert alone > 1e-3
    assert both < 5e-5


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "value"), [(2, -3.195e-3), (5, -2.380e-3)])
def test_a_zero_against_which_flexibilities_were_fitted_is_named(
    tmp_path: Path, seed: int, value: float
) -> None:
    """The zero offset cancels the sag, so that the fit of flexibilities is biased."""
    link = LINKS["ur_rtde"](tmp_path, seed)
    zero, truth = (0.0, 0.0, value, 0.0, 0.0, 0.0), {"joint_offset_3": value}
    link.hidden = HiddenEffects(
        ("joint_offset",), "the zero of a joint is off", truth, {"zero": zero}
    )
    mismatches, alone, both = judged(link, tmp_path)
    assert mismatches == []
    assert alone > 5e-4
    assert both < 5e-5


def judged(link: DemoLink, tmp_path: Path) -> tuple[list[str], float, float]:
    """Return what is wrong in the causes named, and the rms errors (m) without and with them."""
    plant, path = plant_of(link), tmp_path / "calibration.csv"
    write_log(path, measured(link, plant), link.reports_joints)
    log = read_log(path, link.cell.arm.n)
    fitted = identify_compliance(link.cell.model, log, link.cell.metrology)
    flexible = link.cell.model.with_compliance(fitted.axial, fitted.radial)
    save_cell(link.cell, tmp_path / "calibrated.yaml", flexible)
    calibrated = load_cell(tmp_path / "calibrated.yaml")
    causes = [c for ch in diagnose(calibrated.model, log, calibrated.metrology).channels
              for c in ch.causes]  # fmt: skip
    accused = [
        NamedCause(c.effect, tuple((p.name, p.value, p.std or 0.0, p.unit) for p in c.parameters))
        for c in causes
    ]
    terms = [term for c in causes for term in c.terms]
    save_cell(calibrated, tmp_path / "explained.yaml", calibrated.model.with_terms(terms))
    corrected = _refit(path, load_cell(tmp_path / "explained.yaml"), tmp_path)
    alone, both = (
        float(np.sqrt(np.mean(errors(link, plant, cell) ** 2))) for cell in (calibrated, corrected)
    )
    return link.hidden.mismatches(accused), alone, both


def test_seeds_hide_different_effects_over_rtde() -> None:
    drawn = [HiddenEffects.drawn(seed, LINKS["ur_rtde"].effect_choices) for seed in range(1, 9)]
    assert {hidden.effects for hidden in drawn} == {("tool_frame",), ("joint_offset",)}
    assert drawn[0].truth["tool_frame_z"] == pytest.approx(1.413e-3, rel=1e-3)  # as README shows


def test_simulated_zeros_and_a_bent_tool_move_the_true_tcp(tmp_path: Path) -> None:
    link = LINKS["modbus"](tmp_path, 1)
    text = link.cell.path.read_text()
    link.cell.path.write_text(
        text + "  zero: [0.001, 0, 0, 0, 0, 0]\n  tool_shift: [0, 0, 0.002]\n"
    )
    fields = _plant(load_cell(link.cell.path))
    settings = replace(draw_plant_settings(plant_arm(link.cell.arm), 1), **_plant(link.cell))
    plain, other = (
        Plant(plant_arm(link.cell.arm), s, link.home)
        for s in (settings, replace(settings, **fields))
    )
    plain.scatter = other.scatter = (0.0,) * 6
    here = plain.true_tcp()
    turned = np.array(here.origin) + 0.001 * np.cross([0, 0, 1], here.origin)
    along = np.reshape(here.rotation, (3, 3))[:, 2]
    np.testing.assert_allclose(other.true_tcp().origin, turned + 0.002 * along, atol=3e-6)
    link.cell.path.write_text(text + "  zero: [0.001]\n")
    with pytest.raises(CellError, match=r"simulation.zero: found 1 values, expected 6"):
        _plant(load_cell(link.cell.path))
