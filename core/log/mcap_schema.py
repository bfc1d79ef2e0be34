"""The channels of a recording: which fields of a cycle go where, and their protobuf schemas.

Every cycle is one message on each of CYCLE_CHANNELS; the three carry the same ``sequence``. Numbers
are float64, so that what is read back is what was written, bit for bit. Everything else (events,
status, configuration) is JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)

STATE, SETPOINT, LOOP = "/state", "/setpoint", "/loop"
CYCLE_CHANNELS = (STATE, SETPOINT, LOOP)
EVENTS, STATUS, CONFIGURATION, LOG = "/events", "/status", "/configuration", "/log"
JSON_CHANNELS = (EVENTS, STATUS, CONFIGURATION, LOG)
PACKAGE = "gapbridge"
MESSAGES = {STATE: "State", SETPOINT: "Setpoint", LOOP: "Loop"}
ENUM_FIELD = "state"  # of LOOP: the supervisor's state, as an enumeration with names

_STATE_FIELDS = (
    "timestamp", "received", "target_q", "actual_q", "actual_qd", "actual_current_as_torque",
    "joint_temperatures", "payload", "payload_cog", "actual_TCP_force", "ft_raw_wrench",
    "robot_mode", "safety_mode", "runtime_state", "safety_status_bits", "speed_scaling",
)  # fmt: skip
_SETPOINT_FIELDS = (
    "nominal_q", "corrected_q", "offset", "written", "attempted", "own_q", "residual", "clamped",
    "ramp_time",
)  # fmt: skip

Field = FieldDescriptorProto
Sizes = Mapping[str, int]


def fields_by_channel(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return which fields go to which channel, in the order of the schema.

    A name that neither the state nor the setpoint claims goes to LOOP: nothing is left out.
    """
    known = {STATE: _STATE_FIELDS, SETPOINT: _SETPOINT_FIELDS}
    found = {
        channel: tuple(name for name in wanted if name in names)
        for channel, wanted in known.items()
    }
    claimed = {name for group in found.values() for name in group}
    return {**found, LOOP: tuple(name for name in names if name not in claimed)}


def descriptor_set(
    channel: str, names: Sequence[str], sizes: Sizes, states: Sequence[str]
) -> bytes:
    """Return the schema of a cycle channel, as MCAP wants it: a serialized FileDescriptorSet.

    ``sizes``: numbers of each field, 1 = a single one. ``states``: names of the supervisor's
    states, from 0 on.
    """
    message = DescriptorProto(name=MESSAGES[channel])
    for number, name in enumerate(names, start=1):
        is_enum = channel == LOOP and name == ENUM_FIELD
        field = message.field.add(
            name=name,
            number=number,
            label=Field.LABEL_REPEATED if sizes[name] > 1 else Field.LABEL_OPTIONAL,
            type=Field.TYPE_ENUM if is_enum else Field.TYPE_DOUBLE,
        )
        if is_enum:
            field.type_name = f".{PACKAGE}.{MESSAGES[channel]}.Mode"
            kind = message.enum_type.add(name="Mode")
            for value, state in enumerate(states):
                kind.value.add(name=state, number=value)
    file = FileDescriptorProto(
        name=f"{PACKAGE}/{MESSAGES[channel]}.proto",
        package=PACKAGE,
        syntax="proto3",
        message_type=[message],
    )
    return FileDescriptorSet(file=[file]).SerializeToString()


def message_of(schema: bytes) -> DescriptorProto:
    """Return the one message that a schema describes. Raises ValueError where it has none."""
    try:
        files = FileDescriptorSet.FromString(schema).file
    except Exception as error:  # protobuf's own DecodeError, by whichever implementation
        raise ValueError(f"found a schema that is no FileDescriptorSet ({error})") from None
    if not files or not files[0].message_type:
        raise ValueError("found a schema without a message")
    return files[0].message_type[0]


def json_schema(channel: str) -> bytes:
    """Return the JSON schema of a channel that is no cycle channel."""
    text, number, whole = {"type": "string"}, {"type": "number"}, {"type": "integer"}
    properties: dict[str, dict[str, object]] = {
        EVENTS: {
            "time": number, "monotonic": number, "sequence": whole, "cycle": whole, "kind": text,
            "from": text, "to": text, "cause": text, "detail": text,
        },
        STATUS: {"time": number, "state": text, "since": number, "why": text},
        CONFIGURATION: {
            "time": number, "session": text, "segment": whole, "program": text, "cell": text,
            "sha256": text, "text": text, "joints": whole, "clock": number, "every": whole,
        },
        LOG: {
            "timestamp": {
                "type": "object", "title": "time",
                "properties": {"sec": whole, "nsec": whole},
            },
            "level": whole, "message": text, "name": text, "file": text, "line": whole,
        },
    }  # fmt: skip
    return json.dumps(
        {"title": json_name(channel), "type": "object", "properties": properties[channel]}
    ).encode()


def json_name(channel: str) -> str:
    """Return the name of a JSON channel's schema; LOG has Foxglove's own."""
    return "foxglove.Log" if channel == LOG else f"{PACKAGE}.{channel[1:].capitalize()}"
