"""Still more public data sets of real arms as logs and cells; ``convert`` lists them all."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.real import arms
from benchmarks.real.convert_more import with_attitude
from benchmarks.real.converted import Array, Converted, cell_of, poses_of

ORIGIN = (0.1, 0.1, 0.1)  # m: a socket at zeros would be a missing reading
APART = 0.05  # m, between the two sockets


def mukca(links: tuple[arms.Link, ...], robot: str, reach: float) -> Callable[[Path], Converted]:
    """Return poses of a ball on the flange, ``reach`` (m) ahead, in either of two sockets.

    The base with the sockets stood in several places, a session each.
    """

    def make(folder: Path) -> Converted:
        q, position, session = [], [], []
        for number, place in enumerate(sorted((folder / "data" / robot).iterdir())):
            for socket in (0, 1):
                path = place / f"hole_{socket}.csv"
                rows = np.loadtxt(path, delimiter=",", ndmin=2)[:, : len(links)]
                at = np.add(ORIGIN, (APART * socket, 0, 0))
                q.append(rows)
                position.append(np.tile(at, (len(rows), 1)))
                session.append(np.full(len(rows), float(number)))
        about = {
            "robot": f"{robot} of the data set", "instrument": "two sockets 50 mm apart, printed",
            "order": "of the places: by their names; the data set does not say it",
        }  # fmt: skip
        return poses_of(links, np.vstack(q), np.vstack(position), 1e-4, about,
                        np.array([0, 0, reach]), np.concatenate(session))  # fmt: skip

    return make


def ur10_camera(folder: Path) -> Converted:
    """Return poses of a UR10's camera to a marker."""
    path = folder / "examples/ur10/data/calibration.csv"
    raw = np.loadtxt(path, delimiter=",", skiprows=1)
    about = {"robot": "Universal Robots UR10", "instrument": "a camera on its flange, to a marker"}
    attitude = Rotation.from_euler("xyz", raw[:, 3:6]).as_matrix()
    return with_attitude(arms.UR10, raw[:, 6:12], raw[:, :3], attitude, 1e-3, about)


def med7(folder: Path) -> Converted:
    """Return an exciting motion of 20 s."""

    def joints(name: str) -> tuple[Array, Array]:
        path = folder / f"src/test/joint_states_{name}.csv"
        with path.open(encoding="utf-8") as file:
            names = next(csv.reader(file))
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        return rows[:, 0], rows[:, [names.index(f"lbr_joint_{k}") for k in range(7)]]

    (time, q), (_, speed), (_, torque) = (
        joints(name) for name in ("positions", "velocities", "efforts")
    )
    moving = np.flatnonzero((np.abs(speed) > 0.01).any(axis=1))
    rows = moving[0] + np.flatnonzero((np.diff(q[moving[0] - 1 :], axis=0) != 0).any(axis=1))
    columns = {
        "timestamp": time[rows] - time[rows[0]], "actual_q": q[rows], "actual_qd": speed[rows],
        "actual_current_as_torque": -torque[rows],
    }  # fmt: skip
    about = {
        "robot": "KUKA LBR Med 7 R800", "instrument": "its own joint torque sensors, 100 Hz",
        "rows": "those with new joint angles, from the first motion on",
        "torques": "turned: the arm's interface gives what the load does to the joint",
    }  # fmt: skip
    return Converted(columns, cell_of(arms.IIWA7), about)


def so101_teleoperated(folder: Path) -> Converted:
    """Return four episodes in which an SO-101 followed a leader."""
    import pyarrow.parquet as pq

    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    episode, target, actual = (
        np.array(table[name].to_pylist())
        for name in ("episode_index", "action", "observation.state")
    )
    columns = {
        "timestamp": np.arange(len(episode)) / 30.0 + episode,  # 1 s between two episodes
        "target_q": np.deg2rad(target[:, :5]),
        "actual_q": np.deg2rad(actual[:, :5]),
    }
    about = {
        "robot": "SO-101", "instrument": "its servos, 30 Hz",
        "angles": "taken as degrees: the joints' ranges, to which they run from -100 to 100, are "
        "not in the data set",
        "model": "github.com/TheRobotStudio/SO-ARM100, commit fda892c: its URDF, new zeros",
    }  # fmt: skip
    urdf = folder.parent / "SO-ARM100/Simulation/SO101/so101_new_calib.urdf"
    cell = {"robot": {"urdf": "robot.urdf", "tip": "gripper_frame_link"}}
    return Converted(columns, cell, about, urdf.read_text(encoding="utf-8"))
