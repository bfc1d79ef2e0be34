import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from scipy.spatial.transform import Rotation

from benchmarks.real import arms
from benchmarks.real.convert import SOURCES, write
from benchmarks.real.geometry import registered
from benchmarks.real.table import read_table

RNG = np.random.default_rng(12)


def made_of(name, clones):
    source = SOURCES[name]
    write(clones / "out", source, source.make(clones / "set"))
    cell = yaml.safe_load((clones / "out/cell.yaml").read_text(encoding="utf-8"))
    return read_table(clones / "out/log.csv"), cell


def test_a_place_of_the_two_sockets_is_a_session(tmp_path):
    q = {(place, k): RNG.normal(size=(3 + k, 7)) for place in ("front", "left") for k in (0, 1)}
    for (place, k), rows in q.items():
        folder = tmp_path / "set/data/kuka_14" / place
        folder.mkdir(parents=True, exist_ok=True)
        np.savetxt(folder / f"hole_{k}.csv", rows, delimiter=",")
    log, cell = made_of("mukca_iiwa14", tmp_path)
    assert log.get("session").tolist() == [0.0] * 7 + [1.0] * 7
    assert log.joints()[7:10] == pytest.approx(q["left", 0], abs=1e-8)
    at = log.get("measured_position")
    assert at.any(axis=1).all()  # three zeros would be no reading
    assert np.linalg.norm(at[3] - at[0]) == pytest.approx(0.05)
    assert cell["tool"]["tcp"]["xyz"] == [0, 0, 0.04]


def test_a_camera_of_a_nominal_arm_leaves_nothing(tmp_path):
    q = RNG.uniform(-1.5, 1.5, (15, 6))
    at, turned = arms.flange(arms.UR10, q)
    mounted = Rotation.from_euler("xyz", [0.1, 0.2, -0.3]).as_matrix()
    tilt = Rotation.from_euler("xyz", [0.4, 0.1, 1.0]).as_matrix()
    position = (at + turned @ [0.05, 0, 0.1]) @ tilt.T + [1, 2, 3]
    angles = Rotation.from_matrix(tilt @ turned @ mounted).as_euler("xyz")
    place = tmp_path / "set/examples/ur10/data"
    place.mkdir(parents=True)
    np.savetxt(place / "calibration.csv", np.hstack([position, angles, q]), delimiter=",",
               header="names", comments="")  # fmt: skip
    log, cell = made_of("ur10_camera", tmp_path)
    tool, measured = np.array(cell["tool"]["tcp"]["xyz"]), log.get("measured_position")
    nominal = at + turned @ tool
    assert np.abs(registered(nominal, measured) - measured).max() < 1e-6
    assert cell["tool"]["tcp"]["rpy"] == pytest.approx([0.1, 0.2, -0.3], abs=6e-3)


def test_torques_of_a_joint_state_are_ordered_by_name_and_turned(tmp_path):
    place = tmp_path / "set/src/test"
    place.mkdir(parents=True)
    order = (1, 2, 3, 0, 4, 5, 6)
    names = "time," + ",".join(f"lbr_joint_{k}" for k in order)
    q = np.repeat(np.arange(5.0), 2)[:, None] + np.arange(7) * 10.0  # each sent twice
    speed = np.ones((10, 7))
    speed[:4] = 0.0
    for name, values in (("positions", q), ("velocities", speed), ("efforts", 2 * q)):
        rows = np.column_stack([np.arange(10) * 0.005, values[:, order]])
        path = place / f"joint_states_{name}.csv"
        np.savetxt(path, rows, delimiter=",", header=names, comments="")
    log, _ = made_of("med7", tmp_path)
    assert log.joints() == pytest.approx(q[4::2])
    assert log.get("actual_current_as_torque") == pytest.approx(-2 * q[4::2])
    assert log.time == pytest.approx([0, 0.01, 0.02])


def test_a_second_lies_between_two_episodes(tmp_path):
    (tmp_path / "set/data/chunk-000").mkdir(parents=True)
    (tmp_path / "SO-ARM100/Simulation/SO101").mkdir(parents=True)
    urdf = tmp_path / "SO-ARM100/Simulation/SO101/so101_new_calib.urdf"
    urdf.write_text("<robot name='x'/>", encoding="utf-8")
    rows = np.full((4, 6), 90.0).tolist()
    table = pa.table({"episode_index": [0, 0, 1, 1], "action": rows, "observation.state": rows})
    pq.write_table(table, tmp_path / "set/data/chunk-000/file-000.parquet")
    log, _ = made_of("so101_teleoperated", tmp_path)
    assert np.diff(log.time) == pytest.approx([1 / 30, 1 + 1 / 30, 1 / 30])
    assert log.joints() == pytest.approx(np.full((4, 5), np.pi / 2))
