"""More public data sets of real arms as logs and cells; ``convert`` lists them with the others."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.real import arms
from benchmarks.real.converted import (
    Array,
    Converted,
    cell_of,
    poses_of,
    tool_of,
    tracker_of,
)
from benchmarks.real.geometry import rough_tool, rough_turn

# -- FANUC, QKM, Panda: positions --------------------------------------------------------------


def fanuc(folder: Path) -> Converted:
    """Return poses in which one joint moves at a time, three reflectors on the flange."""
    raw = np.loadtxt(folder / "N1N2N3Jval.csv")
    q = np.deg2rad(raw[:, 15:21]) * [1, 1, -1, -1, -1, -1]
    q[:, 2] -= q[:, 1]  # joint 3 is given to the horizontal
    point = raw[:, :9].reshape(-1, 3, 3) * 1e-3
    x = point[:, 1] - point[:, 0]
    z = np.cross(x, point[:, 2] - point[:, 0])
    x, z = (v / np.linalg.norm(v, axis=1)[:, None] for v in (x, z))
    about = {
        "robot": "FANUC R-2000iB/165F, by its dimensions: the data set does not name it",
        "instrument": "laser tracker, three reflectors",
    }
    attitude = np.stack([x, np.cross(z, x), z], axis=2)
    return with_attitude(arms.R2000, q, point[:, 0], attitude, 2e-5, about)


def qkm(folder: Path) -> Converted:
    """Return poses of which each was measured at one of three reflectors, a session each."""
    place = folder / "data files/data_points_cali"
    lines = (place / "c_angles.txt").read_text(encoding="utf-8").splitlines()
    raw = np.array([line.split() for line in lines if line.strip()], dtype=float)
    position = np.loadtxt(place / "c_poses.txt")[: len(raw)] * 1e-3
    order = np.argsort(raw[:, 6], kind="stable")
    about = {"robot": "QKM HL6", "instrument": "laser tracker, one of three reflectors a pose"}
    return poses_of(arms.QKM, np.deg2rad(raw[order, :6]), position[order], 2e-5, about,
                    session=raw[order, 6] - 1)  # fmt: skip


def panda_camera(folder: Path) -> Converted:
    """Return poses of the camera on a Panda's hand, measured by itself to a board."""
    text = (folder / "Examples/calib_data.pickle").read_bytes()
    data = _ArraysOnly(io.BytesIO(text)).load()
    camera = np.array(data["camera_poses"])
    about = {"robot": "Franka Emika Panda", "instrument": "its RealSense camera, to a board"}
    return with_attitude(arms.PANDA, np.array(data["joint_positions"]), camera[:, :3, 3],
                          camera[:, :3, :3], 3e-4, about)  # fmt: skip


class _ArraysOnly(pickle.Unpickler):
    """Reads arrays, and refuses whatever else a pickle may hold."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] != "numpy" or name not in ("_reconstruct", "ndarray", "dtype"):
            raise ValueError(f"pickle: found {module}.{name}, expected arrays")
        return super().find_class(module, name)


def with_attitude(
    links: tuple[arms.Link, ...], q: Array, position: Array, attitude: Array, sigma: float,
    about: dict[str, Any],
) -> Converted:  # fmt: skip
    """Return a log of measured poses; the tool's point and turn are the nominal arm's best."""
    point = rough_tool(links, q, position)
    turn = rough_turn(links, q, point, position, attitude)
    columns = {
        "timestamp": np.arange(len(q)) * 30.0,
        "actual_q": q,
        "measured_position": position,
        "measured_rotation": Rotation.from_matrix(attitude).as_rotvec(),
    }
    about = about | {
        "masses": "left out", "timestamps": "only the order is known: 30 s steps were put in",
        "tool": "point and turn are the best for the nominal arm, rounded to 1 mm and 0.01 rad",
    }  # fmt: skip
    cell = cell_of(links, tool=tool_of(point, turn), metrology=tracker_of(sigma))
    return Converted(columns, cell, about)


# -- force sensors -----------------------------------------------------------------------------

WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")


def ft_poses(folder: Path) -> Converted:
    """Return the readings of a sensor and its load in 24 attitudes."""
    raw = np.genfromtxt(folder / "Data/0-calibration_fts-accel.csv", delimiter=",", names=True)
    return _ft(raw, np.arange(len(raw)) * 10.0, np.column_stack([raw[k] for k in WRENCH]))


def ft_motion(name: str) -> Callable[[Path], Converted]:
    """Return the recording of the same sensor while the arm moves."""

    def make(folder: Path) -> Converted:
        turned, read = (
            np.genfromtxt(folder / f"Data/{name}_{kind}.csv", delimiter=",", names=True)
            for kind in ("orientations", "wrench")
        )
        time = (turned["t"] - turned["t"][0]) * 1e-6
        of_sensor = (read["t"] - turned["t"][0]) * 1e-6
        wrench = np.column_stack([np.interp(time, of_sensor, read[k]) for k in WRENCH])
        return _ft(turned, time, wrench)

    return make


def _ft(raw: Array, time: Array, wrench: Array) -> Converted:
    matrix = np.column_stack([raw[f"r{i}{k}"] for i in "123" for k in "123"])
    about = {
        "instrument": "force sensor on a flange", "payload": "unknown: declared as none",
        "joints": "not recorded: three axes in one point that give the recorded attitude",
    }  # fmt: skip
    q = np.unwrap(arms.attitude_joints(matrix.reshape(-1, 3, 3)), axis=0)
    return Converted({"timestamp": time, "actual_q": q, "ft_raw_wrench": wrench},
                     cell_of(arms.WRIST), about)  # fmt: skip


# -- xMate 7 Pro, LWR 4+, Gen3: torques --------------------------------------------------------


def xmate(number: int) -> Callable[[Path], Converted]:
    """Return one of three exciting motions of 20 s."""

    def make(folder: Path) -> Converted:
        place = folder / "data"
        raw = np.loadtxt(place / f"recdata/xMate7p_traj{number}_results.csv", delimiter=",")
        columns = {
            "timestamp": np.arange(len(raw)) * 0.02, "actual_q": raw[:, :7],
            "actual_qd": raw[:, 7:14], "actual_current_as_torque": raw[:, 21:28],
        }  # fmt: skip
        about = {
            "robot": "Rokae xMate 7 Pro", "instrument": "its own joint torques, 50 Hz",
            "model": "the data set's own URDF",
        }  # fmt: skip
        urdf = (place / "robotparams/XM7p/urdf/XM7p.urdf").read_text(encoding="utf-8")
        return Converted(columns, {"robot": {"urdf": "robot.urdf"}}, about, urdf)

    return make


def lwr4(number: int) -> Callable[[Path], Converted]:
    """Return one of three exciting motions of 25 s."""

    def make(folder: Path) -> Converted:
        raw = np.load(folder / f"data/KUKA/HW/measurements_{number}.npz", encoding="latin1")
        columns = {
            "timestamp": raw["times"] - raw["times"][0], "actual_q": raw["positions"],
            "actual_qd": raw["velocities"], "actual_current_as_torque": raw["torques"],
        }  # fmt: skip
        about = {
            "robot": "KUKA LWR 4+", "instrument": "its own joint torque sensors, 200 Hz",
            "targets": "left out: written in other units and on another clock",
            "model": "the data set's own URDF",
        }  # fmt: skip
        urdf = (folder / "model/kuka_lwr4.urdf").read_text(encoding="utf-8")
        return Converted(columns, {"robot": {"urdf": "robot.urdf", "tip": "lwr_7_link"}}, about,
                         urdf)  # fmt: skip

    return make


def gen3(name: str) -> Callable[[Path], Converted]:
    """Return an exciting motion with commands, temperatures and torque sensors."""

    def make(folder: Path) -> Converted:
        place = folder / "pyDynaMapp"
        raw = np.genfromtxt(place / f"data/kinova/validation_data/{name}.csv", delimiter=",",
                            skip_header=1)  # fmt: skip
        wrong = ~(np.abs(raw[:, 1:57]) < 1e3).all(axis=1) | ~raw[:, 50:57].any(axis=1)
        raw = raw[: int(np.argmax(wrong)) if wrong.any() else len(raw)]
        columns = {
            "timestamp": raw[:, 0] * 1e-3, "target_q": raw[:, 50:57], "actual_q": raw[:, 1:8],
            "actual_qd": raw[:, 8:15], "actual_current_as_torque": raw[:, 22:29],
            "joint_temperatures": raw[:, 36:43],
        }  # fmt: skip
        about = {
            "robot": "Kinova Gen3, seven axes", "instrument": "its own torque sensors, 1 kHz",
            "rows": "those before its commands end", "model": "the data set's own URDF",
        }  # fmt: skip
        urdf = (place / "robot/kinova/gen3.urdf").read_text(encoding="utf-8")
        return Converted(columns, {"robot": {"urdf": "robot.urdf"}}, about, urdf)

    return make
