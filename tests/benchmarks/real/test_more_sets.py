import json
import os
import pickle

import numpy as np
import pytest
import yaml

from benchmarks.real import arms, rivals
from benchmarks.real.convert import SOURCES, write
from benchmarks.real.geometry import registered
from benchmarks.real.judging import _comparable, judge_log
from benchmarks.real.table import Table, read_table

RNG = np.random.default_rng(11)


def made_of(name, tmp_path):
    source = SOURCES[name]
    write(tmp_path / "out", source, source.make(tmp_path))
    return read_table(tmp_path / "out/log.csv"), yaml.safe_load(
        (tmp_path / "out/cell.yaml").read_text(encoding="utf-8")
    )


def test_joint_3_of_a_fanuc_is_given_to_the_horizontal(tmp_path):
    """Moving joint 2 against it leaves the forearm's slope as it is."""
    shown = RNG.uniform(-60, 60, (20, 6))
    q = np.deg2rad(shown) * [1, 1, -1, -1, -1, -1]
    q[:, 2] -= q[:, 1]
    at, turned = arms.flange(arms.R2000, q)
    balls = [at + turned @ t for t in ([0, 0, 0.3], [0.1, 0, 0.3], [0, 0.1, 0.25])]
    raw = np.hstack([*(1e3 * b for b in balls), np.zeros((20, 6)), shown])
    np.savetxt(tmp_path / "N1N2N3Jval.csv", raw)
    log, cell = made_of("fanuc_circles", tmp_path)
    p, R = arms.flange(arms.R2000, log.joints())
    tool, measured = np.array(cell["tool"]["tcp"]["xyz"]), log.get("measured_position")
    assert np.abs(registered(p + R @ tool, measured) - measured).max() < 1e-6
    assert log.get("measured_rotation").shape == (20, 3)


def test_each_reflector_is_a_session(tmp_path):
    place = tmp_path / "data files/data_points_cali"
    place.mkdir(parents=True)
    number = np.tile([3, 1, 2], 8)
    shown = RNG.uniform(-60, 60, (24, 6))
    at, turned = arms.flange(arms.QKM, np.deg2rad(shown))
    mounted = np.array([[0, 0, 0.01], [0, 0.1, 0], [0.1, 0, 0.0]])[number - 1]
    position = at + np.einsum("nij,nj->ni", turned, mounted)
    np.savetxt(place / "c_angles.txt", np.column_stack([shown, number]))
    np.savetxt(place / "c_poses.txt", np.vstack([1e3 * position, np.zeros((4, 3))]))
    log, _ = made_of("qkm", tmp_path)
    assert log.get("session").tolist() == [0.0] * 8 + [1.0] * 8 + [2.0] * 8
    first = np.flatnonzero(number == 1)
    assert log.get("measured_position")[:8] == pytest.approx(position[first], abs=1e-8)


def test_a_load_at_rest_reads_its_weight_whatever_the_attitude(tmp_path):
    (tmp_path / "Data").mkdir()
    from scipy.spatial.transform import Rotation

    R = Rotation.random(12, rng=np.random.default_rng(2)).as_matrix()
    force = np.einsum("nji,j->ni", R, [0, 0, -9.0])
    names = ["fx", "fy", "fz", "tx", "ty", "tz", *(f"r{i}{k}" for i in "123" for k in "123")]
    rows = np.hstack([force, np.zeros((12, 3)), R.reshape(12, 9)])
    np.savetxt(tmp_path / "Data/0-calibration_fts-accel.csv", rows, delimiter=",",
               header=",".join(names), comments="")  # fmt: skip
    log, _ = made_of("ft_poses", tmp_path)
    _, turned = arms.flange(arms.WRIST, log.joints())
    weight = np.einsum("nij,nj->ni", turned, log.get("ft_raw_wrench")[:, :3])
    assert weight == pytest.approx(np.tile([0, 0, -9.0], (12, 1)), abs=1e-6)


def test_a_recording_ends_where_its_commands_do(tmp_path):
    place = tmp_path / "pyDynaMapp"
    (place / "data/kinova/validation_data").mkdir(parents=True)
    (place / "robot/kinova").mkdir(parents=True)
    (place / "robot/kinova/gen3.urdf").write_text("<robot name='x'/>", encoding="utf-8")
    rows = RNG.normal(size=(6, 78))
    rows[4, 54], rows[5, 50:57] = -5e235, 0.0
    path = place / "data/kinova/validation_data/opti_traj_testing1.csv"
    np.savetxt(path, rows, delimiter=",", header="names", comments="")
    log, _ = made_of("gen3_1", tmp_path)
    assert log.get("target_q") == pytest.approx(rows[:4, 50:57])


class Evil:
    def __reduce__(self):
        return os.system, ("true",)


def test_a_pickle_of_more_than_arrays_is_refused(tmp_path):
    (tmp_path / "Examples").mkdir()
    path = tmp_path / "Examples/calib_data.pickle"
    path.write_bytes(pickle.dumps({"joint_positions": Evil()}))
    with pytest.raises(ValueError, match="system, expected arrays"):
        SOURCES["panda_camera"].make(tmp_path)


class OneRowIsAnOutlier:
    """A program that finds nothing, and leaves a row out of its own figure of one log."""

    arguments = ("true",)
    words_of_apply = ()

    def __call__(self, command, log, *rest):
        rows = read_table(log)
        names = tuple(f"predicted_wrench_{k}" for k in range(6))
        Table(names, np.zeros((len(rows), 6))).write(rest[-1])

    def diagnosis(self, log, cell, *arguments):
        figure = 9.0 if "better" in cell.name else 1.0
        channel = {"gap_rms": figure, "verdict": "unexplained", "causes": [], "unit": "N"}
        return {"wrench": channel}


def test_wrenches_are_judged_by_every_row_and_not_by_what_is_left_of_outliers(tmp_path):
    """Of four rows one is easily an outlier, of the one cell's errors and not of the other's."""
    names = ("timestamp", *(f"actual_q_{k}" for k in range(3)),
             *(f"ft_raw_wrench_{k}" for k in range(6)))  # fmt: skip
    q, noise = RNG.uniform(-1, 1, (20, 3)), RNG.normal(size=(20, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    Table(names, np.column_stack([np.arange(20) * 10.0, q, noise])).write(tmp_path / "log.csv")
    cell = {"robot": {"dh": [link.document() for link in arms.WRIST]}}
    (tmp_path / "cell.yaml").write_text(json.dumps(cell), encoding="utf-8")
    (outcome,) = judge_log(tmp_path, OneRowIsAnOutlier())
    assert 0.3 < outcome.ratio < 3
    assert 0.3 < outcome.judged < 3


def test_tracking_is_judged_on_the_rows_that_both_predict():
    ours, theirs = np.ones((4, 2)), np.full((4, 2), 2.0)
    ours[0, 1], theirs[3] = np.nan, np.nan
    ours[1:3] = 3.0
    judged, rival = _comparable("tracking", ours, theirs)
    assert judged.tolist() == [[3.0, 3.0]] * 2
    assert rival.tolist() == [[2.0, 2.0]] * 2


def test_least_squares_of_poses_say_that_they_need_rows(tmp_path):
    log = Table(("timestamp",), np.zeros((3, 1)))
    with pytest.raises(ValueError, match="found a URDF, expected the arm as DH rows"):
        rivals.position_left({"robot": {"urdf": "robot.urdf"}}, log, log)
