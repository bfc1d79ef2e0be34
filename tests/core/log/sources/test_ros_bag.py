"""Bags that rosbags' own writers made, read back: joints by name, times of the headers."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapbridge.core.errors import InputError, LogError
from gapbridge.core.log.sources import SourceOptions, source_of
from gapbridge.core.log.sources.joint_order import UR_JOINTS, order_joints
from gapbridge.core.notes import Reason

rosbags = pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

CONTROLLER = """
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
"""
SHUFFLED = ("elbow_joint", "gripper", "wrist_3_joint", "shoulder_pan_joint", "wrist_1_joint",
            "shoulder_lift_joint", "wrist_2_joint")  # fmt: skip
ROWS = 40


def angles(k: int) -> dict[str, float]:
    """Return the angle of each joint at row k: each its own, so that a mix-up shows."""
    return {name: 0.1 * (i + 1) + 0.01 * k for i, name in enumerate(UR_JOINTS)} | {"gripper": 9.0}


class Bag:
    """A ROS 2 bag being written."""

    def __init__(self, path: Path, plugin: StoragePlugin) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.store.register(
            get_types_from_msg(CONTROLLER, "control_msgs/msg/JointTrajectoryControllerState")
        )
        self.writer = Writer(path, version=9, storage_plugin=plugin)
        self.padding = 0  # bytes behind each message
        self.connections: dict[str, Any] = {}

    def header(self, stamp: float, frame: str = "base") -> Any:
        types = self.store.types
        seconds = int(stamp)
        nanoseconds = round((stamp - seconds) * 1e9)
        time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def write(self, topic: str, kind: str, received: float, **fields: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.store.types[kind](**fields)
        raw = bytes(self.store.serialize_cdr(message, kind)) + bytes(self.padding)
        self.writer.write(self.connections[topic], round(received * 1e9), raw)

    def joint_state(self, k: int, names: tuple[str, ...] = SHUFFLED, topic: str = "/joint_states",
                    stamp: float | None = None) -> None:  # fmt: skip
        at = 100 + 0.01 * k
        q = np.array([angles(k)[name] for name in names])
        self.write(
            topic, "sensor_msgs/msg/JointState", at + 0.5,
            header=self.header(at if stamp is None else stamp), name=list(names), position=q,
            velocity=np.zeros(len(q)), effort=10 * q,
        )  # fmt: skip

    def controller_state(self, k: int) -> None:
        point = self.store.types["trajectory_msgs/msg/JointTrajectoryPoint"]
        duration = self.store.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        names = SHUFFLED[:1] + SHUFFLED[2:]
        q = np.array([angles(k)[name] for name in names])
        empty = np.zeros(0)
        points = [
            point(positions=p, velocities=np.zeros(6), accelerations=empty, effort=empty,
                  time_from_start=duration)
            for p in (q + 0.001, q)
        ]  # fmt: skip
        at = 100.003 + 0.01 * k
        self.write(
            "/scaled_joint_trajectory_controller/controller_state",
            "control_msgs/msg/JointTrajectoryControllerState", at + 0.5,
            header=self.header(at), joint_names=list(names), reference=points[0],
            feedback=points[1],
        )  # fmt: skip

    def pose(self, k: int, topic: str = "/tracker/pose", turned: bool = True) -> None:
        types = self.store.types
        at = 100 + 0.02 * k
        half = 0.01 * k / 2
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=0.1 * k, y=0.0, z=1.0),
            orientation=types["geometry_msgs/msg/Quaternion"](
                x=0.0, y=0.0, z=np.sin(half) * turned, w=np.cos(half) * turned
            ),
        )
        self.write(topic, "geometry_msgs/msg/PoseStamped", at, header=self.header(at), pose=pose)


@pytest.fixture(params=[StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    return Bag(tmp_path / "bag", request.param)


def test_joints_are_ordered_by_name_and_times_are_the_headers(bag: Bag, tmp_path: Path) -> None:
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
            bag.joint_state(k, ("gripper",))  # the gripper's own driver on the same topic
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", (), SourceOptions())
    assert found.joints == UR_JOINTS
    assert np.allclose(found.columns["actual_q"][7], [angles(7)[name] for name in UR_JOINTS])
    assert np.allclose(found.columns["timestamp"], 100 + 0.01 * np.arange(ROWS))
    assert "target_q" not in found.columns
    assert Reason.NO_TARGET in [note.reason for note in found.notes]
    assert Reason.EFFORT_UNKNOWN in [note.reason for note in found.notes]


def test_zeros_behind_a_message_are_no_part_of_it(bag: Bag, tmp_path: Path) -> None:
    bag.padding = 12  # as Fast DDS writes behind empty sequences
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
            bag.controller_state(k)
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", UR_JOINTS, SourceOptions())
    assert np.allclose(found.columns["actual_q"][5], [angles(5)[name] for name in UR_JOINTS])
    assert np.allclose(found.columns["target_q"] - found.columns["actual_q"], 0.001, atol=1e-4)


def test_one_mcap_file_of_a_bag_is_read_too(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag", StoragePlugin.MCAP)
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
    file = next((tmp_path / "bag").glob("*.mcap"))
    found = source_of(file).read(file, UR_JOINTS, SourceOptions(effort_is_torque=True))
    assert np.allclose(found.columns["actual_current_as_torque"], 10 * found.columns["actual_q"])


def test_target_and_actual_come_from_one_controller_message(bag: Bag, tmp_path: Path) -> None:
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
            bag.controller_state(k)
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", UR_JOINTS, SourceOptions())
    difference = found.columns["target_q"] - found.columns["actual_q"]
    assert np.allclose(difference, 0.001)
    assert np.allclose(np.diff(found.columns["timestamp"]), 0.01)


def test_a_tracker_is_interpolated_to_the_joints_times(bag: Bag, tmp_path: Path) -> None:
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
            if k < ROWS // 2 - 5:
                bag.pose(k)
    options = SourceOptions(topics={"pose": "/tracker/pose"})
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", UR_JOINTS, options)
    time = found.columns["timestamp"] - 100
    assert time[-1] <= 0.02 * (ROWS // 2 - 6) + 1e-9  # rows without a measurement are left out
    assert np.allclose(found.columns["measured_position"][:, 0], 0.1 * time / 0.02)
    assert np.allclose(found.columns["measured_rotation"][:, 2], 0.01 * time / 0.02)
    assert Reason.UNCOVERED in [note.reason for note in found.notes]


def test_a_tracker_of_points_has_no_orientation(bag: Bag, tmp_path: Path) -> None:
    """A message of ROS 1 whose orientation nobody sets holds zeros, which are no rotation."""
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
            bag.pose(k, turned=k != 7)
    options = SourceOptions(topics={"pose": "/tracker/pose"})
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", (), options)
    assert found.columns["measured_position"].shape == (ROWS, 3)
    assert "measured_rotation" not in found.columns
    note = next(note for note in found.notes if note.reason is Reason.NO_ROTATION)
    assert note.values == ("/tracker/pose", 1, ROWS)


def test_a_gap_of_the_tracker_is_no_measurement(bag: Bag, tmp_path: Path) -> None:
    with bag.writer:
        for k in range(100):
            bag.joint_state(k)
            if not 10 < k < 30 and k < 50:
                bag.pose(k)
    options = SourceOptions(topics={"pose": "/tracker/pose"})
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", UR_JOINTS, options)
    time = found.columns["timestamp"] - 100
    assert not ((time > 0.2 + 1e-6) & (time < 0.6 - 1e-6)).any()
    assert Reason.GAPS in [note.reason for note in found.notes]


def test_a_tracker_that_nobody_named_is_left_out_and_reported(bag: Bag, tmp_path: Path) -> None:
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
            bag.pose(k)
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", UR_JOINTS, SourceOptions())
    assert "measured_position" not in found.columns
    assert Reason.POSE_UNNAMED in [note.reason for note in found.notes]


def test_two_topics_of_a_type_have_to_be_named(bag: Bag, tmp_path: Path) -> None:
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k)
            bag.joint_state(k, topic="/other/joint_states")
    source = source_of(tmp_path / "bag")
    with pytest.raises(LogError, match=r"found 2 .*joint_states.*--topic joints="):
        source.read(tmp_path / "bag", UR_JOINTS, SourceOptions())
    named = SourceOptions(topics={"joints": "/other/joint_states"})
    assert len(source.read(tmp_path / "bag", UR_JOINTS, named)) == ROWS


def test_messages_without_stamps_count_at_their_time_of_recording(bag: Bag, tmp_path: Path) -> None:
    with bag.writer:
        for k in range(ROWS):
            bag.joint_state(k, stamp=0.0)
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", UR_JOINTS, SourceOptions())
    assert np.allclose(found.columns["timestamp"], 100.5 + 0.01 * np.arange(ROWS))
    assert Reason.NO_STAMPS in [note.reason for note in found.notes]


HUMBLE = ("reference", "feedback", "error", "output", "desired", "actual")
LAYOUTS = {
    "humble": (HUMBLE, HUMBLE), "jazzy": (HUMBLE[:4], HUMBLE[:4]),
    "foxy": (("desired", "actual", "error"), ()),
}  # fmt: skip


@pytest.mark.parametrize("padding", [0, 16])
@pytest.mark.parametrize("distribution", LAYOUTS)
def test_a_controller_state_is_read_from_a_bag_without_definitions(
    tmp_path: Path, distribution: str, padding: int
) -> None:
    points, many = LAYOUTS[distribution]
    kind = "control_msgs/msg/JointTrajectoryControllerState"
    store = get_typestore(Stores.ROS2_HUMBLE)
    text = "std_msgs/Header header\nstring[] joint_names\n"
    text += "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in points)
    text += "string[] multi_dof_joint_names\n" if many else ""
    text += "".join(
        f"trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_{name}\n" for name in many
    )
    store.register(get_types_from_msg(text, kind))
    types, empty = store.types, np.zeros(0)
    duration = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/state", kind, typestore=store)
        for k in range(5):
            q = np.array([angles(k)[name] for name in UR_JOINTS])
            whole = {
                name: types["trajectory_msgs/msg/JointTrajectoryPoint"](
                    q + 0.001 * (name in ("reference", "desired")), empty, empty, empty, duration
                )
                for name in points
            }  # fmt: skip
            multi = types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]
            rest = {f"multi_dof_{name}": multi([], [], [], duration) for name in many}
            rest |= {"multi_dof_joint_names": []} if many else {}
            stamp = types["builtin_interfaces/msg/Time"](sec=100 + k, nanosec=0)
            message = types[kind](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
                joint_names=list(UR_JOINTS), **whole, **rest,
            )  # fmt: skip
            raw = bytes(store.serialize_cdr(message, kind)) + bytes(padding)
            writer.write(connection, (100 + k) * 10**9, raw)
    with contextlib.closing(sqlite3.connect(tmp_path / "bag" / "bag.db3")) as database:
        database.execute("delete from message_definitions")
        database.commit()
    found = source_of(tmp_path / "bag").read(tmp_path / "bag", (), SourceOptions())
    expected = np.array([[angles(k)[name] for name in UR_JOINTS] for k in range(5)])
    assert np.allclose(found.columns["actual_q"], expected)
    assert np.allclose(found.columns["target_q"], expected + 0.001)


def test_a_bag_without_joints_names_the_topics_that_it_has(bag: Any, tmp_path: Path) -> None:
    with bag.writer:
        bag.pose(0)
    with pytest.raises(LogError, match=r"found /tracker/pose \(.*PoseStamped\), expected a JointS"):
        source_of(tmp_path / "bag").read(tmp_path / "bag", (), SourceOptions())


def test_a_ros_1_bag_is_read(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with Writer1(tmp_path / "one.bag") as writer:
        kind = "sensor_msgs/msg/JointState"
        connection = writer.add_connection("/joint_states", kind, typestore=store)
        for k in range(ROWS):
            stamp = types["builtin_interfaces/msg/Time"](sec=100, nanosec=k * 10_000_000)
            header = types["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="")
            q = np.array([angles(k)[name] for name in SHUFFLED])
            message = types[kind](header=header, name=list(SHUFFLED), position=q,
                                  velocity=np.zeros(7), effort=np.zeros(7))  # fmt: skip
            raw = store.serialize_ros1(message, kind)
            writer.write(connection, 100_000_000_000 + k * 10_000_000, raw)
    path = tmp_path / "one.bag"
    found = source_of(path).read(path, UR_JOINTS, SourceOptions())
    assert np.allclose(found.columns["actual_q"][3], [angles(3)[name] for name in UR_JOINTS])


@pytest.mark.parametrize("content", [b"#ROSBAG V2.0\nnot really", b"\x8d\xff\n", b""])
def test_a_broken_bag_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.bag"
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"broken.bag: found no readable bag"):
        source_of(path).read(path, UR_JOINTS, SourceOptions())


def test_a_name_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"b\xff.db3")
    path.write_bytes(b"SQLite format 3\0")
    with pytest.raises(InputError, match="found a name that is not UTF-8, expected one that is"):
        source_of(path).read(path, UR_JOINTS, SourceOptions())


def test_names_say_their_order_by_a_prefix_or_a_number() -> None:
    path = Path("bag")
    prefixed = [f"left_{name}" for name in SHUFFLED]
    assert order_joints(path, prefixed, (), ())[2] == "left_elbow_joint"
    panda = [f"panda_joint{i}" for i in (3, 1, 7, 2, 5, 4, 6)] + ["panda_finger_joint1"]
    arm = tuple(f"joint_{i + 1}" for i in range(7))
    assert order_joints(path, panda, arm, ()) == tuple(f"panda_joint{i}" for i in range(1, 8))


def test_an_arm_alone_says_its_order_beside_its_gripper() -> None:
    path, panda = Path("bag"), [f"panda_joint{i}" for i in range(1, 8)]
    fingers = ["panda_finger_joint1", "panda_finger_joint2"]
    assert order_joints(path, [*fingers, *panda[::-1]], (), ()) == tuple(panda)
    lerobot = ["gripper.pos", "wrist_roll.pos", "wrist_flex.pos", "elbow_flex.pos",
               "shoulder_lift.pos", "shoulder_pan.pos"]  # fmt: skip
    assert order_joints(path, lerobot, (), ()) == tuple(lerobot[:0:-1])
    second = [f"other_joint{i}" for i in range(1, 7)]
    with pytest.raises(LogError, match="--joints"):
        order_joints(path, [*panda, *second], (), ())
    with pytest.raises(LogError, match="joints: found none, expected a known order"):
        order_joints(path, [], (), ())


def test_two_arms_in_one_bag_have_to_be_chosen_between() -> None:
    both = [f"{side}_{name}" for side in ("left", "right") for name in UR_JOINTS]
    with pytest.raises(LogError, match="--joints"):
        order_joints(Path("bag"), both, UR_JOINTS, ())
    chosen = [f"right_{name}" for name in UR_JOINTS]
    assert order_joints(Path("bag"), both, UR_JOINTS, chosen) == tuple(chosen)
    with pytest.raises(LogError, match="did you mean right_elbow_joint"):
        order_joints(Path("bag"), both, UR_JOINTS, ["right_elbow_jont"])
