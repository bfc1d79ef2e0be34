"""Saving cells: the text is kept, the model is new, numbers read back exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.bridge.cell import load_cell, save_cell
from gapbridge.bridge.cell.document import number_text, parse
from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.errors import CellError, RunError, key_path

CONFIG = Path(__file__).parents[3] / "config"
TEXT = """\
# our cell, by the window
robot:
  urdf: arm.urdf  # as delivered
  tip: flange

payload: {mass: 3.0, cog: [0, 0, 0.05]}  # weighed in May

compliance: {axial: [1e-6, 0, 0, 0, 0, 0, 0]}  # old
# a remark about the effects
effects:
  - {effect: backlash, joint: 2, parameters: {value: 1e-4}}  # from March
# the end
"""


def cell_in(folder: Path, text: str = TEXT) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    robot = (CONFIG / "seven_axis.urdf").read_text(encoding="utf-8")
    (folder / "arm.urdf").write_text(robot, encoding="utf-8")
    path = folder / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def every_term(arm: Arm, random: np.random.Generator) -> list[Term]:
    """One occurrence of each effect, at its last site, with values inside its bounds."""
    terms = []
    for effect in CATALOGUE.values():
        site = effect.sites(arm)[-1]
        if effect.identifier == "transmission_error":
            site = type(site)(site.joint, 81.5)
        values = [
            float(np.clip(random.standard_normal() * p.scale, p.lower, p.upper))
            for p in effect.parameters(arm, site)
        ]
        terms.append(Term(effect.identifier, site, tuple(values)))
    return terms


def test_a_written_cell_reads_back_number_for_number(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    cell = load_cell(cell_in(tmp_path))
    others = [t for t in every_term(cell.arm, random) if not t.effect.endswith("l_compliance")]
    model = cell.model.without_terms().with_terms(others)
    model = model.with_compliance(random.uniform(0, 1e-5, 7), random.uniform(0, 1e-6, 7))
    save_cell(cell, tmp_path / "new.yaml", model)
    again = load_cell(tmp_path / "new.yaml").model
    assert set(again.terms) == set(model.terms)
    assert len(again.terms) == len(model.terms)


def test_comments_order_and_other_keys_stay(tmp_path: Path) -> None:
    cell = load_cell(cell_in(tmp_path))
    save_cell(cell, tmp_path / "new.yaml", cell.model.with_compliance([2e-6] * 7, [0] * 7))
    text = (tmp_path / "new.yaml").read_text()
    for phrase in (
        "# our cell, by the window",
        "urdf: arm.urdf  # as delivered",
        "{mass: 3.0, cog: [0, 0, 0.05]}  # weighed in May",
        "# a remark about the effects",
        "# the end",
    ):
        assert phrase in text
    assert text.index("payload") < text.index("compliance") < text.index("effects")
    assert text.count("compliance:") == 1


def test_relative_paths_hold_from_the_new_folder(tmp_path: Path) -> None:
    cell = load_cell(cell_in(tmp_path / "a" / "b"))
    (tmp_path / "c").mkdir()
    save_cell(cell, tmp_path / "c" / "new.yaml")
    again = load_cell(tmp_path / "c" / "new.yaml")
    assert again.file.robot.urdf == Path("../a/b/arm.urdf")
    np.testing.assert_array_equal(again.arm.link_in_link, cell.arm.link_in_link)


WITH_PATHS = """\
robot: {model: ur10e, calibration: calibration.conf}
link:
  {driver: modbus, profile: mine.yaml, transport: tls, authority: ca.pem, certificate: c.pem,
   key: k.pem}
setpoints: {source: tcp, file: track.csv, socket: s.sock, token_file: t}  # by the planner
recording: {folder: runs}
web: &served {certificate: w.pem, key: w.key, token_file: w.token}
metrics: *served
calibration: {folder: sessions, instrument: {kind: folder, unit: mm, folder: tracker}}
"""
KEYS_OF_PATHS = {
    "robot": ["calibration"],
    "link": ["authority", "certificate", "key", "profile"],
    "setpoints": ["file", "socket", "token_file"],
    "recording": ["folder"],
    "web": ["certificate", "key", "token_file"],
    "metrics": ["certificate", "key", "token_file"],
    "calibration": ["instrument.folder", "folder"],
}


def files_of(path: Path) -> dict[str, Path]:
    """The absolute paths that a cell states, by their keys."""
    paths = load_cell(path).file.paths()
    return {key_path(keys): (path.parent / stated).resolve() for keys, stated in paths}


def test_every_path_of_a_cell_holds_from_the_new_folder(tmp_path: Path) -> None:
    source = cell_in(tmp_path / "a" / "b", WITH_PATHS)
    (source.parent / "calibration.conf").write_text("[mounting]\ndelta_a = [0, 0, 0, 0, 0, 1e-4]\n")
    (tmp_path / "c").mkdir()
    written = tmp_path / "c" / "new.yaml"
    save_cell(load_cell(source), written)
    named = [f"{section}.{key}" for section, keys in KEYS_OF_PATHS.items() for key in keys]
    assert sorted(files_of(source)) == sorted(named)
    assert files_of(written) == files_of(source)
    text = written.read_text()
    assert "profile: ../a/b/mine.yaml" in text
    assert "# by the planner" in text


@pytest.mark.parametrize(
    ("text", "stated"),
    [
        ("link: {driver: replay, file: run.mcap}", "file: ../a/run.mcap"),
        ("link: {driver: can, profile: mine.yml}", "profile: ../a/mine.yml"),
        ("link: {driver: can, profile: piper}", "profile: piper}"),
        ("calibration: {instrument: {kind: file, unit: mm, file: m.csv}}", "file: ../a/m.csv"),
    ],
)
def test_a_path_is_moved_whatever_kind_of_section_states_it(
    tmp_path: Path, text: str, stated: str
) -> None:
    source = cell_in(tmp_path / "a", f"robot: {{model: ur10e}}\n{text}\n")
    (tmp_path / "c").mkdir()
    save_cell(load_cell(source), tmp_path / "c" / "new.yaml")
    assert stated in (tmp_path / "c" / "new.yaml").read_text()


def test_beside_the_old_cell_paths_stay_as_they_are_written(tmp_path: Path) -> None:
    source = cell_in(tmp_path, TEXT.replace("arm.urdf", "./arm.urdf"))
    save_cell(load_cell(source), tmp_path / "new.yaml")
    assert "urdf: ./arm.urdf  # as delivered" in (tmp_path / "new.yaml").read_text()


def test_an_absolute_path_stays_as_it_is(tmp_path: Path) -> None:
    source = cell_in(tmp_path / "a")
    absolute = str(source.with_name("arm.urdf"))
    source.write_text(TEXT.replace("arm.urdf", absolute))
    (tmp_path / "c").mkdir()
    save_cell(load_cell(source), tmp_path / "c" / "new.yaml")
    assert load_cell(tmp_path / "c" / "new.yaml").file.robot.urdf == Path(absolute)


@pytest.mark.parametrize(
    "text",
    [
        "{robot: {urdf: arm.urdf}, payload: {mass: 1.0}}",
        "robot: {urdf: arm.urdf}\ncompliance:\n  axial: &a [0, 0, 0, 0, 0, 0, 1]\n  radial: *a\n",
        "---\nrobot: {urdf: arm.urdf}\n...\n",
        "robot:\n  urdf: arm.urdf\ncompliance:\n  axial:\n  - 0\n" + "  - 1.0e-6\n" * 6,
        "robot:\n  urdf: arm.urdf\neffects:\ncompliance:",
        "robot: {'urdf': 'arm.urdf'}",
        "robot: {urdf: arm.urdf}\r\neffects: []\r\n",
    ],
)
def test_any_style_of_yaml_is_written_back_right(tmp_path: Path, text: str) -> None:
    cell = load_cell(cell_in(tmp_path, text))
    model = cell.model.with_compliance([1e-6 / 3] * 7, [1e-7 / 7] * 7)
    (tmp_path / "deep").mkdir()
    save_cell(cell, tmp_path / "deep" / "new.yaml", model)
    again = load_cell(tmp_path / "deep" / "new.yaml")
    assert again.model.terms == model.terms
    assert again.file.payload == cell.file.payload


def test_a_cell_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    cell = load_cell(cell_in(tmp_path))
    with pytest.raises(RunError, match="cannot be written"):
        save_cell(cell, tmp_path / "none" / "new.yaml")
    target = tmp_path / "new.yaml"
    save_cell(cell, target)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["arm.urdf", "cell.yaml", "new.yaml"]


def test_a_text_of_digits_stays_a_text(tmp_path: Path) -> None:
    text = '{robot: {urdf: arm.urdf}, calibration: {serial: "2024e5", folder: "../1e5"}}\n'
    cell = load_cell(cell_in(tmp_path / "c", text))
    save_cell(cell, tmp_path / "new.yaml")
    again = load_cell(tmp_path / "new.yaml").file.calibration
    assert (again.serial, str(again.folder)) == ("2024e5", "1e5")


def test_a_cell_that_could_not_be_loaded_is_not_written(tmp_path: Path) -> None:
    cell = load_cell(cell_in(tmp_path))
    target = tmp_path / "new.yaml"
    target.write_text("the old one\n")
    limp = cell.model.with_compliance([2.0] * 7, [0.0] * 7)
    with pytest.raises(RunError, match=r"nothing is written.*compliance.axial entry 1: found 2"):
        save_cell(cell, target, limp)
    assert target.read_text() == "the old one\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["arm.urdf", "cell.yaml", "new.yaml"]


@settings(max_examples=200, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_number_reads_back_exactly(value: float) -> None:
    data = parse(f"a: {number_text(value)}", Path("x")).data
    assert isinstance(data["a"], float)
    assert data["a"] == value


def test_a_model_with_a_stiffening_joint_keeps_its_linear_part_apart(tmp_path: Path) -> None:
    cell = load_cell(cell_in(tmp_path))
    site = CATALOGUE["stiffness_nonlinearity"].sites(builtin_arm("ur10e"))[2]
    deflected = Term("stiffness_nonlinearity", site, (5e-6, 1e-4))
    model = cell.model.without_terms().with_compliance([1e-6] * 7, [0] * 7).with_terms([deflected])
    save_cell(cell, tmp_path / "new.yaml", model)
    again = load_cell(tmp_path / "new.yaml")
    assert again.file.compliance.axial == [1e-6] * 7
    assert again.model.terms == model.terms


def test_a_stand_in_keeps_its_mark(tmp_path: Path) -> None:
    cell = load_cell(cell_in(tmp_path))
    marked = [
        Term("axial_compliance", Site(2), (3e-6,), stand_in=True),
        Term("backlash", Site(1), (1e-4,), stand_in=True),
    ]
    proved = Term("backlash", Site(3), (2e-4,))
    new = tmp_path / "new.yaml"
    save_cell(cell, new, cell.model.with_terms([*marked, proved]))
    read = {(t.effect, t.site.joint): t.stand_in for t in load_cell(new).model.terms}
    assert read["axial_compliance", 2]  # beside what the cell's own section holds of that joint
    assert read["backlash", 1]
    assert not read["backlash", 3]
    again = tmp_path / "again.yaml"
    save_cell(load_cell(new), again)
    assert again.read_text().count("stand_in: true") == 2


def test_links_of_nearly_parallel_axes_may_be_without_the_second_twist(tmp_path: Path) -> None:
    """Cells written before such links had one load, and are written back as they were."""
    robot = "robot: {model: ur10e, calibration: {delta_alpha: [0, 1e-3, 0, 0, 0, 0]}}\n"
    entry = (
        "effects:\n  - {effect: link_geometry, joint: %d, parameters: {a: 1e-4, d: 0, alpha: 0}}"
    )
    old = tmp_path / "old.yaml"
    old.write_text(robot + entry % 2)
    cell = load_cell(old)
    assert cell.model.terms == (Term("link_geometry", Site(2), (1e-4, 0.0, 0.0)),)
    save_cell(cell, tmp_path / "new.yaml")
    assert load_cell(tmp_path / "new.yaml").model.terms == cell.model.terms
    old.write_text(robot + entry % 3)  # exactly parallel
    with pytest.raises(CellError, match="beta"):
        load_cell(old)
