"""Public data sets of real arms as logs and cells.

``python -m benchmarks.real.convert CHECKOUTS --out DIR``: CHECKOUTS holds clones of the sources
under their own names (``git clone https://github.com/OWNER/NAME``; hanbyeolyoonucla's, a second
``robot-calibration``, as ``meca500``); what is not there is skipped. Later commits of FloBaRoID,
dynamic-identification and dynamic_parameter_identification lack their data: these three at the
commits of ``SOURCES``.
None of these sets is part of this repository.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from benchmarks.real import arms
from benchmarks.real import convert_further as further
from benchmarks.real import convert_more as more
from benchmarks.real.converted import (
    Array,
    Columns,
    Converted,
    cell_of,
    poses_of,
    tool_of,
    tracker_of,
)
from benchmarks.real.geometry import rough_tool, rough_turn
from benchmarks.real.spreadsheet import read_sheet

GAINS = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])  # Nm/A of the UR10e, as published


@dataclass(frozen=True)
class Source:
    """A data set: where it comes from and how it becomes a log."""

    repository: str  # owner/name on GitHub
    commit: str  # the one that was converted here
    make: Callable[[Path], Converted]
    clone: str = ""  # its folder, where another source's has the same name

    @property
    def folder(self) -> str:
        """Return the name of the clone."""
        return self.clone or self.repository.partition("/")[2]


# -- UR10e, currents ---------------------------------------------------------------------------


def _ur10e(name: str, first: int, last: int) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        (path,) = folder.glob(f"dataset_ur10e/*/{name}")
        raw = np.loadtxt(path, delimiter=",")[first - 1 : last]
        columns = {
            "timestamp": raw[:, 0] - raw[0, 0],
            "actual_q": raw[:, 1:7],
            "actual_qd": raw[:, 7:13],
            "actual_current_as_torque": raw[:, 13:19] * GAINS,
        }
        about = {
            "robot": "Universal Robots UR10e",
            "instrument": "motor currents of its controller, 100 Hz, times its drives' gains as "
            "the data set's authors quote them (14.87 13.26 11.13 10.62 11.03 11.47 Nm/A)",
            "file": str(path.relative_to(folder)), "rows": f"{first} to {last}: the motion",
            "payload": "none",
        }  # fmt: skip
        return Converted(columns, cell_of(arms.UR10E), about)

    return make


# -- force sensor ------------------------------------------------------------------------------


def _force_sensor(folder: Path) -> Converted:
    pose = np.loadtxt(folder / "datas/recorded_messages_pose_100.txt", delimiter=",")
    wrench = np.loadtxt(folder / "datas/recorded_messages_wrench_100.txt", delimiter=",")
    rotation = Rotation.from_quat(pose[:, 3:7]).as_matrix()
    inside = np.einsum("nji,nkj->nki", rotation, wrench.reshape(-1, 2, 3)).reshape(-1, 6)
    columns = {
        "timestamp": np.arange(len(pose)) * 10.0,
        "actual_q": arms.attitude_joints(rotation),
        "ft_raw_wrench": inside,
    }
    about = {
        "instrument": "ATI Axia80 flange sensor, 100 poses; recorded in base axes, turned back "
        "into the sensor's by the recorded attitude",
        "joints": "not recorded: three axes in one point that give the recorded attitude",
        "timestamps": "not recorded: 10 s steps were put in",
        "payload": "a gripper of unknown mass: declared as none",
    }
    return Converted(columns, cell_of(arms.WRIST), about)


# -- KUKA iiwa, laser tracker ------------------------------------------------------------------

IIWA = {0.0: "0kg/20161216_run1_0kg.csv", 1.25: "1.25kg/20161216_run2_1.25kg.csv",
        2.5: "2.5kg/20161216_run3_2.5kg.csv"}  # fmt: skip


def _iiwa(*loads: float) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        parts = [(load, _iiwa_rows(folder / IIWA[load])) for load in loads]
        raw = np.vstack([rows for _, rows in parts])
        mass = np.concatenate([np.full(len(rows), load) for load, rows in parts])
        about = {
            "payload": f"{', '.join(f'{x:g}' for x in loads)} kg at the flange, centre of gravity "
            "put at (0, 0, 0.05) m; the reflector was mounted anew for each load",
        }
        session = np.repeat(np.arange(len(parts)), [len(rows) for _, rows in parts]).astype(float)
        more = {"session": session} if len(parts) > 1 else {}
        return _iiwa_log(raw, mass, about, more)

    return make


def _iiwa_rows(path: Path) -> Array:
    return np.genfromtxt(path, delimiter=",", skip_header=2)  # as its authors: without the candle


def _iiwa_log(raw: Array, mass: Array, about: dict[str, Any], more: Columns) -> Converted:
    q, frame = raw[:, 1:8], raw[:, 15:31].reshape(-1, 4, 4)
    position = frame[:, :3, 3] * 1e-3
    first = slice(None) if "session" not in more else more["session"] == 0
    point = rough_tool(arms.IIWA7, q[first], position[first])
    turn = rough_turn(arms.IIWA7, q[first], point, position[first], frame[first, :3, :3])
    columns = {
        "timestamp": np.arange(len(q)) * 30.0,
        "actual_q": q,
        "payload": mass,
        "payload_cog": np.tile([0.0, 0.0, 0.05], (len(q), 1)),
        "measured_position": position,
        "measured_rotation": Rotation.from_matrix(frame[:, :3, :3]).as_rotvec(),
    } | more
    about = {
        "robot": "KUKA iiwa 7 R800", "instrument": "laser tracker with a six-dof probe",
        "timestamps": "only the order is known: 30 s steps were put in",
        "tool": "point and turn are the best for the nominal arm, rounded to 1 mm and 0.01 rad",
    } | about  # fmt: skip
    cell = cell_of(arms.IIWA7, tool=tool_of(point, turn), metrology=tracker_of(2e-5))
    return Converted(columns, cell, about)


def _iiwa_month_before(folder: Path) -> Converted:
    raw = np.genfromtxt(folder / "20161118_run_1.csv", delimiter=",", skip_header=2)
    return _iiwa_log(raw, np.zeros(len(raw)), {"payload": "not reported, put as 0 kg"}, {})


# -- Motoman, IRB 120, UR10: laser trackers ----------------------------------------------------

MOTOMAN = "UserData/Robots/Motoman/Dataset/leica_dataset/"


def _motoman(name: str, tool: tuple[float, float, float] | None) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        raw = np.asarray(loadmat(folder / MOTOMAN / name)["dataset"], dtype=float)
        raw = raw[~np.isnan(raw[:, 19:22]).any(axis=1)]
        raw = raw[np.unique(raw[:, 0], return_index=True)[1]]  # as its authors: one row a pose
        q, position = raw[:, 7:13], raw[:, 19:22]
        point = np.array(tool) if tool else rough_tool(arms.MA1400, q, position)
        torso = (arms.Link(0, 15 * np.pi / 180, -0.263, -np.pi / 2),)
        down = arms.flange(torso, np.zeros((1, 1)))[1][0].T @ [0, 0, -9.80665]
        cell = cell_of(
            arms.MA1400,
            tool=tool_of(point),
            gravity=[float(x) for x in down],
            metrology=tracker_of(1e-5),
        )
        about = {
            "robot": "Yaskawa Motoman MA1400, right arm of a pair on one torso", "file": name,
            "instrument": "Leica AT403 laser tracker", "masses": "not known, left out",
            "timestamps": "only the order is known: 30 s steps were put in",
            "tool": "as its authors give it" if tool else
            "the tool point is the best for the nominal arm, rounded to 1 mm",
        }  # fmt: skip
        columns = {
            "timestamp": np.arange(len(q)) * 30.0,
            "actual_q": q,
            "measured_position": position,
        }
        return Converted(columns, cell, about)

    return make


def _irb120(folder: Path) -> Converted:
    place = folder / "4-DataProcess/Output"
    q = np.deg2rad(np.loadtxt(place / "processed_joints.txt"))
    position = np.loadtxt(place / "processed_SMR_1.txt") * 1e-3
    point = rough_tool(arms.IRB120, q, position)
    about = {
        "robot": "ABB IRB 120", "instrument": "FARO laser tracker, first of three reflectors",
        "masses": "not known, left out", "rows": "those that its authors kept",
        "timestamps": "only the order is known: 30 s steps were put in",
        "tool": "the tool point is the best for the nominal arm, rounded to 1 mm",
    }  # fmt: skip
    columns = {"timestamp": np.arange(len(q)) * 30.0, "actual_q": q, "measured_position": position}
    cell = cell_of(arms.IRB120, tool=tool_of(point), metrology=tracker_of(3e-5))
    return Converted(columns, cell, about)


def _ur10(name: str) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        lines = (folder / name).read_text(encoding="utf-8-sig").splitlines()
        head = lines[0].split(";")
        rows = [line.replace(",", ".").split(";") for line in lines[1:] if line.strip()]

        def column(title: str) -> Array:
            return np.array([float(r[head.index(title)]) for r in rows])

        q = np.column_stack([column(head[k]) for k in range(7, 13)])
        position = np.column_stack([column(f"measurement_{x}") for x in "xyz"]) * 1e-3
        about = {
            "robot": "Universal Robots UR10 (CB series), the arm of series A and B",
            "instrument": "Leica laser tracker with T-Mac, position of the T-Mac's origin",
            "file": name, "joints": "commanded (the controller is at rest)",
            "timestamps": "only the order is known: 30 s steps were put in",
        }  # fmt: skip
        columns = {
            "timestamp": np.arange(len(q)) * 30.0,
            "actual_q": q,
            "measured_position": position,
        }
        cell = cell_of(arms.UR10, tool=tool_of(np.array([0, 0, 0.109])), metrology=tracker_of(2e-5))
        return Converted(columns, cell, about)

    return make


# -- Staubli TX2-90L, IRB 120 again, Rokae: laser trackers ---------------------------------------


def _staubli(task: str) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        q, position = _staubli_rows(folder / "Data" / task)
        # other tasks hold one attitude, in which no tool point shows: that of the calibration
        point = rough_tool(arms.TX2_90L, *_staubli_rows(folder / "Data/Calibration"))
        about = {
            "robot": "Staubli TX2-90L, by its dimensions: the data set does not name it",
            "instrument": "Leica laser tracker with T-Mac, position of the T-Mac's origin",
            "data set": "HUST_NC_Robot, doi 10.17632/srxktn4752.1", "file": task,
            "tool": "the point is the best for the nominal arm in the 40 poses for calibration, "
            "rounded to 1 mm",
        }  # fmt: skip
        return poses_of(arms.TX2_90L, q, position, 1e-5, about, point)

    return make


def _staubli_rows(place: Path) -> tuple[Array, Array]:
    q = np.deg2rad(np.array(read_sheet(place / "theta.xlsx")[1:], dtype=float))
    lines = (place / "Leica.csv").read_text(encoding="latin-1").splitlines()[1:]
    return q, np.array([[float(x) for x in line.split(",")[:3]] for line in lines]) * 1e-3


def _irb120_position_only(folder: Path) -> Converted:
    from scipy.io import loadmat

    place = folder / "MinimalPositionCalibration"

    def read(name: str) -> Array:
        return np.asarray(loadmat(place / f"{name}.mat")[name], dtype=float)

    parts = [
        (read("CaliJointAngles"), read("CaliPosition")[::3]),
        (read("TestJointAngles"), read("TestPosition")),
        (read("TestJointAngles2"), read("TestPosition2")),
    ]
    about = {
        "robot": "ABB IRB 120 (Wu and others, IEEE T-ASE 12 (2015) 758)",
        "instrument": "not named; 36 poses for calibration (the first of three points) and 10 and "
        "30 test poses, with another point on the tool each",
    }
    session = np.repeat([0.0, 1.0, 2.0], [len(q) for q, _ in parts])
    q, position = (np.vstack([part[k] for part in parts]) for k in (0, 1))
    return poses_of(arms.IRB120, np.deg2rad(q), position * 1e-3, 3e-5, about, session=session)


def _rokae(folder: Path) -> Converted:
    targets = (folder / "data/joint_angle.csv").read_text(encoding="utf-8")
    found = re.findall(r"jointtarget \w+ = j:\{([^}]*)\}", targets)
    q = np.deg2rad([[float(x) for x in row.split(",")[:6]] for row in found])
    lines = (folder / "data/laser_pos.csv").read_text(encoding="utf-8").splitlines()
    measured = np.array([line.split()[7:10] for line in lines if line.strip()], dtype=float)
    about = {"robot": "Rokae, six axes", "instrument": "laser tracker; the measured columns"}
    return poses_of(arms.ROKAE, q, measured * 1e-3, 2e-5, about)


# -- Panda, torques and tracking ---------------------------------------------------------------


def _panda(folder: Path) -> Converted:
    place = folder / "matlab/data/Exciting_Traj/Trajectory_1"

    def column(name: str) -> Array:
        return np.loadtxt(place / name).reshape(-1, 7)

    log = {
        k: column(f"rbt_log/exciting_traj_{k}.txt") for k in ("positions", "velocity", "torques")
    }
    count = len(log["positions"])
    time = np.loadtxt(place / "rbt_log/exciting_traj_time.txt")[:count]
    steps = np.loadtxt(place / "gen_time.txt")[:count]
    speed, start = column("gen_dq.txt")[:count], np.loadtxt(place / "gen_q0.txt")
    middle = (speed[1:] + speed[:-1]) / 2 * np.diff(steps)[:, None]
    wanted = start + np.vstack([np.zeros((1, 7)), np.cumsum(middle, axis=0)])
    keep = np.arange(0, count, 2)
    columns = {
        "timestamp": time[keep] - time[0],
        "target_q": wanted[keep],
        "actual_q": log["positions"][keep],
        "actual_qd": log["velocity"][keep],
        "actual_current_as_torque": log["torques"][keep],
    }
    about = {
        "robot": "Franka Emika Panda", "instrument": "its own joint torque sensors, 1 kHz; every "
        "second row", "targets": "the generated speeds, integrated from the first angles",
        "model": "kinematics and inertials of the public description of the arm",
    }  # fmt: skip
    return Converted(columns, {"robot": {"urdf": "robot.urdf", "tip": "flange"}}, about,
                     arms.panda_urdf())  # fmt: skip


# -- Staubli TX40, torques; KUKA KR300, torques; UR5e, tracking ---------------------


def _tx40(folder: Path) -> Converted:
    place = folder / "examples/staubli_TX40"
    ratio = np.array([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    to_joints, to_torques = np.diag(ratio), np.diag(ratio)
    to_joints[5, 4] = to_torques[4, 5] = ratio[5]  # motor 6 turns with joint 5

    def column(name: str) -> Array:
        raw = np.loadtxt(place / f"data/{name}.csv", delimiter=",", skiprows=1)
        return raw[:37_500].reshape(-1, 10, 6).mean(axis=1)

    zero = np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])
    q = column("pos_read_data") @ np.linalg.inv(to_joints).T + zero
    columns = {
        "timestamp": np.arange(len(q)) * 2e-3,
        "actual_q": q,
        "actual_current_as_torque": column("curr_data") @ to_torques.T,
    }
    about = {
        "robot": "Staubli TX40", "instrument": "motor angles and torques, 5 kHz, means of ten, "
        "times the gears' ratios; motor 6 turns with joint 5",
        "rows": "the motion, 7.5 s",
        "model": "kinematics and inertials of the data set's own URDF",
    }  # fmt: skip
    urdf = (place / "urdf/tx40_mdh_modified.urdf").read_text(encoding="utf-8")
    return Converted(columns, {"robot": {"urdf": "robot.urdf", "tip": "tool0"}}, about, urdf)


def _kr300(name: str) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        place = folder / f"data/recorded_trajectories/2020-10-21 10s FF {name} 08ms/data.mat"
        rec = loadmat(place, squeeze_me=True, struct_as_record=False)["rec"]
        ratio = np.array([1798 / 7, 1872 / 7, 757 / 3, 221, 5032 / 21, 206793 / 1340])
        columns = {
            "timestamp": rec.time_cont,
            "actual_q": np.deg2rad(rec.act_pos_mot_deg.T),
            "actual_qd": np.deg2rad(rec.act_vel_mot_deg_per_s.T),
            "actual_current_as_torque": rec.act_torque_abs_nm.T * ratio,
        }
        about = {
            "robot": "KUKA Quantec Ultra KR300, 200 kg at its flange", "file": place.name,
            "instrument": "motor angles, speeds and torques, 250 Hz, times the gears' ratios",
            "targets": "left out: the motors of the wrist are coupled by a ratio that is not given",
            "model": "masses and centres of gravity of the data set's own model; its hydraulic "
            "counterbalance of joint 2 is in no model here",
        }  # fmt: skip
        return Converted(columns, cell_of(arms.KR300, gravity=[0, 0, 9.80665]), about)

    return make


def _ur5e_motion(folder: Path) -> Converted:
    raw = np.genfromtxt(folder / "UR5e_motion_full.csv", delimiter=",", names=True)

    def vector(name: str) -> Array:
        return np.column_stack([raw[f"{name}_{i}"] for i in range(6)])

    columns = {
        "timestamp": np.arange(len(raw)) * 8e-3,
        "target_q": vector("tq"),
        "actual_q": vector("q"),
        "actual_qd": vector("qd"),
    }
    about = {
        "robot": "Universal Robots UR5e", "instrument": "its controller, 125 Hz",
        "timestamps": "written as whole seconds: 8 ms steps were put in",
    }  # fmt: skip
    return Converted(columns, {"robot": {"model": "ur5e"}}, about)


# -- Meca500, AUBO i5, Doosan M1013: positions -------------------------------------------------


def _meca500(*names: str) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        raw = np.vstack([
            np.loadtxt(folder / f"data_calibration/{name}_Output.csv", delimiter=",")
            for name in names
        ])  # fmt: skip
        begins = np.r_[True, np.abs(np.diff(raw[:, :6], axis=0)).max(axis=1) > 0]
        pose = np.cumsum(begins) - 1
        count = np.bincount(pose)
        position = np.column_stack([np.bincount(pose, x) / count for x in raw[:, 6:9].T])
        about = {
            "robot": "Mecademic Meca500", "files": ", ".join(names),
            "instrument": "laser tracker, by its resolution: not named; means of three readings",
        }  # fmt: skip
        return poses_of(arms.MECA500, np.deg2rad(raw[begins, :6]), position, 1e-5, about)

    return make


def _aubo(name: str, joints: str = "CAL", columns: int = 0) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        place = folder / "dataLib/kinematicsCalibrationData" / name

        def numbers(file: str) -> Array:
            lines = (place / file).read_text(encoding="utf-8").splitlines()
            rows = [re.split(r"[,\s]+", line.strip()) for line in lines if line.strip()]
            return np.array(rows, dtype=float)

        number = joints.removeprefix("CAL")
        q, measured = numbers(f"{joints}.txt"), numbers(f"mesurements{number}.txt")
        q = np.deg2rad(q) if np.abs(q).max() > 2 * np.pi else q
        position = measured[: len(q), columns : columns + 3] * 1e-3
        point = rough_tool(arms.AUBO_I5, q, position)
        about = {
            "robot": "AUBO i5", "instrument": "Leica laser tracker", "file": name,
            "timestamps": "only the order is known: 30 s steps were put in",
            "tool": "the tool point is the best for the nominal arm, rounded to 1 mm",
        }  # fmt: skip
        columns_of_log = {
            "timestamp": np.arange(len(q)) * 30.0, "actual_q": q, "measured_position": position,
        }  # fmt: skip
        cell = cell_of(arms.AUBO_I5, tool=tool_of(point), metrology=tracker_of(2e-5))
        return Converted(columns_of_log, cell, about)

    return make


def _aubo_torques(number: int) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        place = folder / "dataLib/dynamicCalibrationData/date_internal/torque_q_data"
        q, qd, torque = (
            np.loadtxt(place / f"aubo_{x}_{number}.txt") for x in ("q", "qd", "current")
        )
        columns = {
            "timestamp": np.arange(len(q)) * 5e-3, "actual_q": q, "actual_qd": qd,
            "actual_current_as_torque": torque,
        }  # fmt: skip
        about = {
            "robot": "AUBO i5", "instrument": "motor currents as torques, 200 Hz, means of the "
            "periods of an exciting motion of 10 s",
        }  # fmt: skip
        return Converted(columns, cell_of(arms.AUBO_I5), about)

    return make


def _m1013(height: float, *names: str) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        rows = []
        for number, name in enumerate(names):
            text = (folder / f"data/datasets/{name}.yaml").read_text(encoding="utf-8")
            stations = yaml.load(text, Loader=yaml.CSafeLoader)["column_heights"][height]
            rows += [
                (number, m["time"], *m["joint_states"][1:], *m["prism_position"])
                for station in stations["solution_spaces"].values()
                for measured in station.values() for m in measured
            ]  # fmt: skip
        raw = np.array(rows)
        raw = raw[np.lexsort((raw[:, 1], raw[:, 0]))]
        columns = {
            "timestamp": raw[:, 1] - raw[0, 1],
            "actual_q": raw[:, 2:8],
            "measured_position": raw[:, 8:11],
        }
        columns |= {"session": raw[:, 0]} if len(names) > 1 else {}
        about = {
            "robot": f"Doosan M1013 on a lifting column at {height} m (Hilti JaiBot, prototype); "
            "the column bends under the arm, and has play where it is high",
            "instrument": "total station, 0.75 mm", "files": ", ".join(names),
        }  # fmt: skip
        cell = cell_of(
            arms.M1013, tool=tool_of(np.array([-0.10091, -0.00102, 0.33566])),
            gravity=[0.0, -9.80665, 0.0], metrology=tracker_of(7.5e-4),
        )  # fmt: skip
        return Converted(columns, cell, about)

    return make


# -- UR10, Rokae AR5: torques; SO-101: tracking ------------------------------------------------


def _ur10_bag(folder: Path) -> Converted:
    import sqlite3

    path = folder / "ur10_inverse_dynamics_solver/bagfiles/ur10_exciting_trajectory.db3"
    messages = "select data from messages order by timestamp"
    with sqlite3.connect(path) as bag:
        # a JointState ends with three vectors of six numbers, each with its length before it
        raw = np.array([np.frombuffer(m[-168:], "<f8") for (m,) in bag.execute(messages)])
    columns = {
        "timestamp": np.arange(len(raw)) * 8e-3,
        "actual_q": raw[:, 1:7],
        "actual_qd": raw[:, 8:14],
        "actual_current_as_torque": raw[:, 15:21],
    }
    about = {"robot": "Universal Robots UR10 (CB series)",
             "instrument": "motor currents times the drives' gains, 125 Hz"}  # fmt: skip
    return Converted(columns, {"robot": {"model": "ur10"}}, about)


def _ar5(folder: Path) -> Converted:
    raw = np.loadtxt(folder / "src/config/dynamics_identification_data_real.csv", delimiter=",",
                     skiprows=1)  # fmt: skip
    columns = {
        "timestamp": raw[:, 0],
        "actual_q": raw[:, 1:8],
        "actual_qd": raw[:, 8:15],
        "actual_current_as_torque": raw[:, 22:29],
    }
    about = {
        "robot": "Rokae AR5, seven axes", "instrument": "its own joint torques, 50 Hz",
        "gravity": "along x of the base: not stated, the weights show it (9.9 m/s², 0.7 Nm left)",
        "model": "the data set's own URDF",
    }  # fmt: skip
    urdf = (folder / "urdf/AR5-5_07R-W4C4A2.urdf").read_text(encoding="utf-8")
    return Converted(
        columns, {"robot": {"urdf": "robot.urdf"}, "gravity": [9.80665, 0.0, 0.0]}, about, urdf
    )


def _so101(name: str) -> Callable[[Path], Converted]:
    def make(folder: Path) -> Converted:
        place = folder / "output/real/so101/custom" / name

        def vectors(file: str, column: str) -> Array:
            with (place / file).open(encoding="utf-8") as lines:
                return np.array([json.loads(row[column]) for row in csv.DictReader(lines)])[:, :5]

        time = np.loadtxt(place / "state_motor.csv", delimiter=",", skiprows=1, usecols=1) * 1e-6
        columns = {
            "timestamp": time - time[0],
            "target_q": vectors("control.csv", "positions"),
            "actual_q": vectors("state_motor.csv", "positions"),
            "actual_qd": vectors("state_motor.csv", "velocities"),
        }
        about = {
            "robot": "SO-101, Feetech STS3215 with a proportional gain of 16, no integral",
            "instrument": "its servos, 50 Hz", "file": name,
            "torques": "left out: the servos' currents have no sign",
            "model": "github.com/TheRobotStudio/SO-ARM100, commit fda892c: its URDF, new zeros",
        }  # fmt: skip
        urdf = folder.parent / "SO-ARM100/Simulation/SO101/so101_new_calib.urdf"
        cell = {"robot": {"urdf": "robot.urdf", "tip": "gripper_frame_link"}}
        return Converted(columns, cell, about, urdf.read_text(encoding="utf-8"))

    return make


UR10E_SET = ("shamilmamedov/dynamic_calibration", "11af40e7deb758ec080a175fed8fcdd6c99aca29")
IIWA_SET = ("Zhangzhongqiu/robot-calibration", "be44742b3b312bde09d87d9d40e89d8a634ac83b")
MOTOMAN_SET = ("ctu-vras/multirobot-calibration", "a20f0454732bc36f1d980ff08c3d30536b8b1b19")
KR300_SET = ("JonasWeigand/Robot_Identification", "9e403c07d9dadbb391a9f3921e8d219f714636a8")
UR10_SET = ("christianlandgraf/ipa-robot-accuracy", "507fba69bdaf6c43c2faf306e70a7e37c5e39b89")
STAUBLI_SET = ("ZhangTeng-Hust/ASTL", "e1ae9638bce784e778661322a89705a78514a006")
MECA500_SET = ("hanbyeolyoonucla/robot-calibration", "33d50d777f1e182ddefb2774b054b090c6009ae7")
AUBO_SET = ("ziyiyuan/MyRobot", "d49fbc03d1364436c826ac87de8a114fa9dd189f")
M1013_SET = ("Hilti-Research/construction_robot_stationing_datasets",
             "f26546d2f8fc8cf2adf619ffff69505126b0794e")  # fmt: skip
XMATE_SET = ("NKU-ZiXuan/xMate7p_dyn_ident", "7d8c9246adfc2a14d161df41a21a70671471ac1c")
LWR4_SET = ("kjyv/FloBaRoID", "e6c077ea5c09bceb49840f49e83450bb5979029b")
GEN3_SET = ("wissem01chiha/dynamic-identification", "90ba37d676d8da6c064d9edf5c1a09389309752e")
FT_SET = ("AndreFug/AIS2202-Modul2", "1b73c0cacb0fd34853648b8057ed708cab5e788c")
MUKCA_SET = ("platonics-delft/kinematics_calibration", "05a05ab4cbbe328c8f5bfcc76479c752ed07b82e")
SO101_SET = ("isaac-sim2real/sage", "4ffd2627df9d23e279b35712a67e629ce0c0dfa7")
SOURCES: dict[str, Source] = {
    "ur10e_12harmonics": Source(*UR10E_SET, _ur10e("ur-20_02_10-30sec_12harm.csv", 635, 3510)),
    "ur10e_8harmonics": Source(*UR10E_SET, _ur10e("ur-20_02_05-20sec_8harm.csv", 320, 2310)),
    "ur10e_50s": Source(*UR10E_SET, _ur10e("ur-20_02_12-50sec_12harm.csv", 355, 5090)),
    "ur10e_point_to_point": Source(*UR10E_SET, _ur10e("ur-20_01_17-ptp_10_points.csv", 700, 4200)),
    "force_sensor_100": Source(
        "leledeyuan00/Gravity-Compensation-F-T-sensor",
        "139efe1841f97391002655ef370911d0417feaed", _force_sensor),
    "iiwa_three_loads": Source(*IIWA_SET, _iiwa(0.0, 1.25, 2.5)),
    "iiwa_0kg": Source(*IIWA_SET, _iiwa(0.0)),
    "iiwa_month_before": Source(*IIWA_SET, _iiwa_month_before),
    "motoman_cube": Source(*MOTOMAN_SET, _motoman(
        "leica_right_hand_6x6x6_dataset.mat", (0.0418, -0.0167, 0.245))),
    "motoman_wide": Source(*MOTOMAN_SET, _motoman("updated_leica_dataset.mat", None)),
    "irb120": Source(
        "icelinker/Robot-Calibration-LaserTracker",
        "188abd2d773b26dd32bafe50943c3ab0044a72d8", _irb120),
    "ur10_c": Source(*UR10_SET, _ur10("Series_C/measurements_random_poses.csv")),
    "ur10_d": Source(*UR10_SET, _ur10("Series_D/measurements_iso_cubes.csv")),
    "tx2_calibration": Source(*STAUBLI_SET, _staubli("Calibration")),
    "tx2_points": Source(*STAUBLI_SET, _staubli("POINTS")),
    "tx2_line": Source(*STAUBLI_SET, _staubli("LINE")),
    "tx2_curve": Source(*STAUBLI_SET, _staubli("CURVE")),
    "tx2_surface": Source(*STAUBLI_SET, _staubli("SURFACE")),
    "irb120_position_only": Source(
        "drliaowu/Minimal_Robot_Calibration_Using_Position",
        "376cb83006b7ae4ae3328761c406e22e78c4be06", _irb120_position_only),
    "rokae_30": Source(
        "dongjy-s/LM_PyTorch", "e87ba15f454ab23fbfa3e16db524f7557d80b56a", _rokae),
    "panda": Source(
        "marcocognetti/FrankaEmikaPandaDynModel",
        "24d85ce4e648e2e894c832bfeee9b16711eb1a1a", _panda),
    "tx40": Source(
        "thanhndv212/figaroh-examples", "c0b5c7f0fda10078be55104f9ee76ac106b7a5ee", _tx40),
    "kr300_a": Source(*KR300_SET, _kr300("A")),
    "kr300_b": Source(*KR300_SET, _kr300("B")),
    "kr300_c": Source(*KR300_SET, _kr300("C")),
    "ur5e_motion": Source(
        "MingyuTang0728/Universal-Robots-Notts",
        "3bfbff1de97d4b82fdbc0203a44d85b33b3dd2fa", _ur5e_motion),
    "meca500_right": Source(*MECA500_SET, _meca500(
        "CAL00004_Right_Large160", "CAL00004_Right_Small80"), "meca500"),
    "meca500_left": Source(*MECA500_SET, _meca500(
        "CAL00005_Left_Large160", "CAL00005_Left_Small80"), "meca500"),
    "aubo_i5_0101": Source(*AUBO_SET, _aubo("Leica0101")),
    "aubo_i5_0706": Source(*AUBO_SET, _aubo("Leica_1", "CAL1")),
    "aubo_i5_0917": Source(*AUBO_SET, _aubo("Leica0917")),
    "aubo_i5_0918": Source(*AUBO_SET, _aubo("Leica0918", columns=3)),  # before: fitted values
    "aubo_i5_0920": Source(*AUBO_SET, _aubo("Leica0920_1")),
    "aubo_i5_0921": Source(*AUBO_SET, _aubo("Leica0921_1")),
    "aubo_i5_0922": Source(*AUBO_SET, _aubo("Leica0922")),
    **{f"aubo_i5_torques_{k}": Source(*AUBO_SET, _aubo_torques(k)) for k in (1, 2, 3)},
    "m1013_low": Source(*M1013_SET, _m1013(1.98, "flat")),
    "m1013_high": Source(*M1013_SET, _m1013(3.87, "flat")),
    "m1013_high_on_pallet": Source(*M1013_SET, _m1013(3.87, "pallet")),
    "m1013_seven_places": Source(*M1013_SET, _m1013(
        1.98, "pallet", "flat", "orthogonal_wood", "wood_left_track", "diagonal_wood", "seesaw",
        "outdoor")),
    "ur10_excitation": Source(
        "unisa-acg/inverse-dynamics-solver",
        "41e196de5ca340f2b48e443484a7c74a77533da4", _ur10_bag),
    "ar5": Source(
        "FrankJIE09/Dynamics_identification_Frank",
        "758dc8d6f78e63ecba0aac16d28255ae045f1d3c", _ar5),
    "fanuc_circles": Source(
        "RABKKK/LaserTrackerPoseData4KinIdent",
        "e143dda2bf5280359912ed7618f2b63d7e262b58", more.fanuc),
    "qkm": Source(
        "Alcatrazee/Robot_calibration", "e15794b38dcc2cc907ca04c69dd692d3ab273329", more.qkm),
    "panda_camera": Source(
        "PhilNad/robot-arm-kinematic-calibration",
        "6e0292a27caedfd3a205502115d243868fafc00d", more.panda_camera),
    "ft_poses": Source(*FT_SET, more.ft_poses),
    "ft_motion": Source(*FT_SET, more.ft_motion("1-baseline")),
    "ft_vibrations": Source(*FT_SET, more.ft_motion("2-vibrations")),
    **{f"xmate_{k}": Source(*XMATE_SET, more.xmate(k)) for k in (1, 2, 3)},
    **{f"lwr4_{k}": Source(*LWR4_SET, more.lwr4(k)) for k in (1, 2, 3)},
    **{f"gen3_{k}": Source(*GEN3_SET, more.gen3(f"opti_traj_testing{k}")) for k in (1, 2)},
    "mukca_panda_2": Source(*MUKCA_SET, further.mukca(arms.PANDA, "panda_2_clean", 0.139)),
    "mukca_panda_3": Source(*MUKCA_SET, further.mukca(arms.PANDA, "panda_3", 0.139)),
    "mukca_iiwa14": Source(*MUKCA_SET, further.mukca(arms.IIWA14, "kuka_14", 0.04)),
    "mukca_gen3lite": Source(*MUKCA_SET, further.mukca(arms.GEN3_LITE, "dinova_2", 0.187)),
    "ur10_camera": Source(
        "thanhndv212/figaroh-examples", "c0b5c7f0fda10078be55104f9ee76ac106b7a5ee",
        further.ur10_camera),
    "med7": Source(
        "lbr-stack/dynamic_parameter_identification",
        "951558d66aa9f2a7aaa208dcaf0f6e0263438369", further.med7),
    "so101_teleoperated": Source(
        "SamueleSandrini/record-test", "c6d0de303c6f4c451eb103222af2fff11d0e9963",
        further.so101_teleoperated),
    **{f"so101_{name}": Source(*SO101_SET, _so101(name)) for name in (
        "multisine", "random_waypoints", "large_amplitude", "backlash_detection")},
}  # fmt: skip


def write(folder: Path, source: Source, made: Converted) -> None:
    """Write log.csv, cell.yaml, ABOUT.yaml (and robot.urdf) into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    names, values = [], []
    for name, column in made.columns.items():
        wide = column.reshape(len(column), -1)
        names += [name] if column.ndim == 1 else [f"{name}_{k}" for k in range(wide.shape[1])]
        values.append(wide)
    np.savetxt(folder / "log.csv", np.hstack(values), delimiter=",", fmt="%.9g",
               header=",".join(names), comments="")  # fmt: skip
    about = {"source": f"github.com/{source.repository}, commit {source.commit[:7]}"} | made.about
    for name, document in (("cell.yaml", made.cell), ("ABOUT.yaml", about)):
        text = yaml.safe_dump(document, sort_keys=False, width=100)
        (folder / name).write_text(text, encoding="utf-8")
    if made.urdf is not None:
        (folder / "robot.urdf").write_text(made.urdf, encoding="utf-8")


@click.command()
@click.argument("checkouts", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True,
              help="Folder for one folder a log.")  # fmt: skip
@click.option("--only", "names", default=None, help="Sets by name, by commas.")
def main(checkouts: Path, out: Path, names: str | None) -> None:
    """Convert the data sets whose clones lie in CHECKOUTS."""
    for name in names.split(",") if names else SOURCES:
        if name not in SOURCES:
            raise click.UsageError(f"set: found {name!r}, expected one of {', '.join(SOURCES)}")
        source = SOURCES[name]
        if not (checkouts / source.folder).is_dir():
            click.echo(f"{name}: skipped, no clone of github.com/{source.repository} there")
            continue
        try:
            made = source.make(checkouts / source.folder)
        except (OSError, ValueError) as error:
            click.echo(f"{name}: skipped, {error}")
            continue
        write(out / name, source, made)
        click.echo(f"{name}: {len(made.columns['timestamp'])} rows")


if __name__ == "__main__":
    main()
