"""ROS bags: ROS 1 ``.bag``, ROS 2 folders and ``.db3``, MCAP files with ROS 2 messages.

Topics are found by their type, times are those of the headers, joints are ordered by name.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gapbridge.core.errors import LogError, LogOptionError
from gapbridge.core.files import require_utf8
from gapbridge.core.log.sources.joint_order import order_joints
from gapbridge.core.log.sources.resampling import Stream, joined
from gapbridge.core.log.sources.source import Converted, Source, SourceOptions
from gapbridge.core.notes import Note, Reason

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

TYPES = {  # role -> types of messages
    "joints": ("sensor_msgs/msg/JointState",),
    "controller": ("control_msgs/msg/JointTrajectoryControllerState",),
    "wrench": ("geometry_msgs/msg/WrenchStamped",),
    "pose": ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"),
}
CONTROLLER = TYPES["controller"][0]
POINTS, MULTI = (
    "trajectory_msgs/JointTrajectoryPoint",
    "trajectory_msgs/MultiDOFJointTrajectoryPoint",
)
LAYOUTS = (  # of the controller's state by ROS distribution: points, then points of many axes
    (("reference", "feedback", "error", "output", "desired", "actual"),
     ("reference", "feedback", "error", "output", "desired", "actual")),  # Humble
    (("reference", "feedback", "error", "output"),
     ("reference", "feedback", "error", "output")),  # Jazzy and later
    (("desired", "actual", "error"), ()),  # before Humble
)  # fmt: skip
WRENCHES = ("ft_raw_wrench", "actual_TCP_force")
MOST_TOPICS = 8  # named where none will do
WORD, MOST_PADDING = bytes(4), 256  # bytes behind a message
Reader = Callable[[bytes, str], Any]  # of a message's bytes and type


@dataclass
class _Samples:
    """What came on one topic: times and, by joint name or field, values."""

    topic: str
    time: list[float] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    received: int = 0  # messages without a header stamp, which count at their time of recording
    frame: str = ""


class RosBag(Source):
    """A recording of ROS topics."""

    identifier = "ros_bag"
    title = "ROS 1 or ROS 2 bag, MCAP with ROS 2 messages"
    options = ("joints", "topics", "wrench", "effort_is_torque")

    def holds(self, path: Path) -> bool:
        """Return whether this is a bag."""
        if path.is_dir():
            return (path / "metadata.yaml").is_file()
        if path.suffix == ".mcap":
            return path.is_file() and _is_ros_mcap(path)
        return path.suffix in (".bag", ".db3") and path.is_file()

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log of a bag; see ``Source.read``."""
        samples = {}
        notes: list[Note] = []
        with _opened(path) as bag:
            for role in TYPES:
                topic = _topic(path, bag, role, options, notes)
                if topic:
                    samples[role] = _collect(path, bag, topic)
            topics = sorted({f"{c.topic} ({_type(c.msgtype)})" for c in bag.connections})
        if not samples.keys() & {"joints", "controller"}:
            raise LogError(
                f"{path}: topics: found {', '.join(topics[:MOST_TOPICS]) or 'none'}"
                f"{', ...' if len(topics) > MOST_TOPICS else ''}, expected a JointState or a "
                "JointTrajectoryControllerState among them"
            )
        notes += [
            Note(Reason.NO_STAMPS, (one.topic, one.received, len(one.time)))
            for one in samples.values()
            if one.received
        ]
        order = order_joints(path, _names(samples), arm_joints, options.joints)
        streams = _streams(path, samples, order, options, notes)
        time, columns, more = joined(streams[0], streams[1:])
        notes += more
        if "target_q" not in columns:
            notes.append(Note(Reason.NO_TARGET))
        return Converted({"timestamp": time, **columns}, order, tuple(notes))


def _is_ros_mcap(path: Path) -> bool:
    from mcap.reader import make_reader
    from mcap.records import Schema
    from mcap.stream_reader import StreamReader

    from gapbridge.core.log.mcap_records import BROKEN  # as late as its library

    try:
        with path.open("rb") as file:
            if make_reader(file).get_header().profile == "ros2":
                return True
            file.seek(0)
            for record in StreamReader(file, emit_chunks=False).records:
                if isinstance(record, Schema):
                    return record.encoding in ("ros2msg", "ros2idl")
    except (*BROKEN, OSError):
        pass
    return False


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise LogError(
            f"{path}: found a ROS bag, expected rosbags to be installed: pip install "
            "'gapbridge[ros]'"
        ) from None
    require_utf8(path)
    try:
        bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        bag.open()
    except (AnyReaderError, OSError, ValueError) as error:  # ValueError: bytes that are no text
        raise LogError(f"{path}: found no readable bag ({error})") from None
    with contextlib.closing(bag):
        yield bag


def _topic(
    path: Path, bag: AnyReader, role: str, options: SourceOptions, notes: list[Note]
) -> str | None:
    """Return the topic of a role: the requested one, or the only one of its type."""
    topics = sorted({c.topic for c in bag.connections if _type(c.msgtype) in TYPES[role]})
    requested = options.topics.get(role)
    if requested is not None:
        if requested not in topics:
            listed = ", ".join(topics) or "none"
            raise LogOptionError(
                f"{path}: --topic {role}: found {listed} of type {TYPES[role][0]}, expected "
                f"{requested}"
            )
        return requested
    if role == "wrench" and topics and not options.wrench:
        notes.append(Note(Reason.WRENCH_UNKNOWN, (topics, WRENCHES)))
        return None
    if role == "pose" and topics:
        notes.append(Note(Reason.POSE_UNNAMED, (topics,)))
        return None
    if len(topics) > 1:
        raise LogOptionError(
            f"{path}: topics: found {len(topics)} of type {TYPES[role][0]} ({', '.join(topics)}), "
            f"expected one; name it with --topic {role}=TOPIC"
        )
    return topics[0] if topics else None


def _type(name: str) -> str:
    """Return a message's type in ROS 2's form (ROS 1 in rosbags has it as well)."""
    return name if "/msg/" in name else name.replace("/", "/msg/")


def _collect(path: Path, bag: AnyReader, topic: str) -> _Samples:
    from rosbags.highlevel import AnyReaderError

    samples = _Samples(topic)
    connections = [c for c in bag.connections if c.topic == topic]
    read: Reader | None = None
    try:
        for connection, received, data in bag.messages(connections):
            read = read or _reader(path, bag, connection.msgtype, data)
            message: Any = read(data, connection.msgtype)
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            if stamp == 0:
                stamp, samples.received = received * 1e-9, samples.received + 1
            samples.time.append(stamp)
            samples.rows.append(_values(_type(connection.msgtype), message))
            samples.frame = message.header.frame_id
    except AnyReaderError as error:
        raise LogError(f"{path}: topic {topic}: cannot be read ({error})") from None
    if not samples.rows:
        raise LogError(f"{path}: topic {topic}: found no messages, expected some")
    return samples


def _reader(path: Path, bag: AnyReader, kind: str, data: bytes) -> Reader:
    """Return the reader of messages of a type, of which ``data`` is one.

    Bags of SQLite before ROS 2 Iron hold no definitions: a controller's state is then read by the
    first layout that fits its bytes. Raises LogError where none does.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if kind in bag.typestore.fielddefs:
        return _padded(bag.deserialize)
    for most in (0, MOST_PADDING):  # zeros behind one layout may be the fields of a longer one
        for points, many in LAYOUTS if _type(kind) == CONTROLLER else ():
            lines = ["std_msgs/Header header", "string[] joint_names"]
            lines += [f"{POINTS} {name}" for name in points]
            lines += ["string[] multi_dof_joint_names"] if many else []
            lines += [f"{MULTI} multi_dof_{name}" for name in many]
            store = get_typestore(Stores.ROS2_HUMBLE)
            store.register(get_types_from_msg("\n".join(lines), kind))
            try:
                _padded(store.deserialize_cdr, most)(data, kind)
            except Exception:  # whatever another layout's bytes lead to
                continue
            return _padded(store.deserialize_cdr)
    raise LogError(
        f"{path}: found no definition of {kind} in the bag, expected one; rewrite it with "
        "`ros2 bag convert` as MCAP, which holds them"
    )


def _padded(read: Reader, most: int = MOST_PADDING) -> Reader:
    """Return a reader that takes up to ``most`` zeros behind a message.

    Fast DDS, ROS 2's usual middleware, counts an alignment for every empty sequence that it does
    not write; rosbags refuses more than three further bytes. What is read is the same, because
    the message holds its lengths.
    """

    def read_padded(data: bytes, kind: str) -> Any:
        end = len(data)
        while True:
            try:
                return read(data[:end], kind)
            except Exception:  # rosbags' own, of several kinds
                if end <= len(data) - most or bytes(data[end - len(WORD) : end]) != WORD:
                    raise
            end -= len(WORD)

    return read_padded


def _values(kind: str, message: Any) -> dict[str, Any]:
    """Return the values of a message, in joint order where it has names."""
    if kind in TYPES["joints"]:
        return {
            "names": tuple(message.name), "actual_q": message.position,
            "actual_qd": message.velocity, "effort": message.effort,
        }  # fmt: skip
    if kind in TYPES["controller"]:
        target = getattr(message, "reference", None) or getattr(message, "desired", None)
        actual = getattr(message, "feedback", None) or getattr(message, "actual", None)
        return {
            "names": tuple(message.joint_names),
            "target_q": target.positions if target else (),
            "actual_q": actual.positions if actual else (),
            "actual_qd": actual.velocities if actual else (),
        }
    if kind in TYPES["wrench"]:
        force, torque = message.wrench.force, message.wrench.torque
        return {"wrench": [force.x, force.y, force.z, torque.x, torque.y, torque.z]}
    pose = getattr(message, "pose", None) or message.transform
    position = getattr(pose, "position", None) or pose.translation
    turn = getattr(pose, "orientation", None) or pose.rotation
    return {
        "measured_position": [position.x, position.y, position.z],
        "measured_rotation": [turn.x, turn.y, turn.z, turn.w],
    }


def _names(samples: dict[str, _Samples]) -> tuple[str, ...]:
    """Return all joint names in the order in which they first came."""
    names: dict[str, None] = {}
    for role in ("controller", "joints"):
        for row in samples[role].rows if role in samples else ():
            names.update(dict.fromkeys(row["names"]))
    return tuple(names)


def _streams(
    path: Path, samples: dict[str, _Samples], order: tuple[str, ...], options: SourceOptions,
    notes: list[Note],
) -> list[Stream]:  # fmt: skip
    """Return the streams, the one whose times are taken first."""
    streams = [
        stream
        for role in ("controller", "joints")
        if role in samples
        for stream in _joint_stream(samples[role], order, options, notes)
    ]
    if not streams:
        raise LogError(
            f"{path}: joints: found no message that holds all of {', '.join(order)}, expected some"
        )
    if "wrench" in samples:
        one = samples["wrench"]
        column = options.wrench or WRENCHES[0]
        values = np.array([row["wrench"] for row in one.rows])
        streams.append(Stream(one.topic, np.array(one.time), {column: values}).in_order())
        notes.append(Note(Reason.TAKEN_AS, (one.topic, column, one.frame)))
    if "pose" in samples:
        from scipy.spatial.transform import Rotation

        one = samples["pose"]
        columns = {"measured_position": np.array([row["measured_position"] for row in one.rows])}
        turns = np.array([row["measured_rotation"] for row in one.rows])
        length = np.linalg.norm(turns, axis=1)
        without = int(np.sum(~(np.isfinite(length) & (length > 0))))  # a tracker of points alone
        if without:
            notes.append(Note(Reason.NO_ROTATION, (one.topic, without, len(turns))))
        else:
            columns["measured_rotation"] = Rotation.from_quat(turns).as_rotvec()
        streams.append(Stream(one.topic, np.array(one.time), columns).in_order())
    return streams


def _joint_stream(
    samples: _Samples, order: tuple[str, ...], options: SourceOptions, notes: list[Note]
) -> Iterator[Stream]:
    """Yield the stream of a topic with joints, if a message of it holds all of them."""
    whole = [i for i, row in enumerate(samples.rows) if set(order) <= set(row["names"])]
    if not whole:
        return
    columns = {}
    for source, column in (("target_q",) * 2, ("actual_q",) * 2, ("actual_qd",) * 2,
                           ("effort", "actual_current_as_torque")):  # fmt: skip
        lists = [_in_order(samples.rows[i], source, order) for i in whole]
        if any(values is None for values in lists):
            continue
        if source == "effort" and not options.effort_is_torque:
            notes.append(Note(Reason.EFFORT_UNKNOWN, (samples.topic,)))
            continue
        columns[column] = np.array(lists, dtype=float)
    if columns:
        time = np.array(samples.time)[whole]
        yield Stream(samples.topic, time, columns).in_order()


def _in_order(row: dict[str, Any], key: str, order: tuple[str, ...]) -> list[float] | None:
    """Return a message's values in the order of the arm's joints, None where it has none."""
    values = row.get(key)
    if values is None or len(values) != len(row["names"]):
        return None
    by_name = dict(zip(row["names"], values, strict=True))
    return [float(by_name[name]) for name in order]
