"""``gapbridge convert``."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from gapbridge.bridge.cell.opened_log import joint_names
from gapbridge.bridge.cli.options import FILE, open_cell
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.document.output_file import require_table, write_table
from gapbridge.core.errors import InputError, LogError
from gapbridge.core.log.columns import PARQUET
from gapbridge.core.log.sources import SOURCES, Source, SourceOptions, source_of
from gapbridge.core.log.sources.ros_bag import TYPES, WRENCHES

ROLES = tuple(TYPES)
OPTIONS = {  # by the field of SourceOptions
    one.name: "--topic" if one.name == "topics" else f"--{one.name.replace('_', '-')}"
    for one in fields(SourceOptions)
}


@click.command()
@click.argument("source", type=FILE)
@click.option(
    "--out", required=True, type=FILE, metavar="LOG", help="The log to write, .csv or .parquet."
)
@click.option("--cell", type=FILE, help="The cell whose arm's joints are meant.")
@click.option(
    "--joints", metavar="A,B,...", help="The source's joint names, in the order of the arm's."
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="ROLE=TOPIC",
    help=f"Name a topic of a bag; ROLE is {', '.join(ROLES)}. May be given several times.",
)
@click.option("--wrench", type=click.Choice(WRENCHES), help="Which column a bag's wrench topic is.")
@click.option("--effort-is-torque", is_flag=True, help="JointState.effort is joint torque in Nm.")
@click.option(
    "--calibration", type=FILE, metavar="FILE", help="LeRobot's calibration file of the arm."
)
@click.option(
    "--units", type=click.Choice(("degrees", "rad")), help="What a LeRobot dataset's angles are in."
)
@click.option("--episode", type=click.IntRange(0), help="One episode of a LeRobot dataset.")
def convert(source: Path, out: Path, cell: Path | None, **options: Any) -> None:
    """Convert a recording of another program to a log.

    SOURCE is a ROS 1 or ROS 2 bag (JointState, JointTrajectoryControllerState, WrenchStamped,
    PoseStamped or TransformStamped of a tracker; topics are found by their type), an MCAP file with
    ROS 2 messages, a LeRobot dataset, libfranka's CSV, the file of UR's RTDE recorder, or a
    recording of `gapbridge run`. Joints are ordered by name, never by position; times are those of
    the headers. Missing information is reported.

    Example: gapbridge convert bag/ --cell cell.yaml --out log.csv
    """
    kind = source_of(source)
    if kind is None:
        if not source.exists():
            raise LogError(f"{source}: not found, expected a file or folder")
        known = "; ".join(one.title for one in SOURCES)
        plain = source.name.lower().endswith((".csv", ".csv.gz", *PARQUET))
        also = "; a file with columns such as actual_q_0 is a log as it stands" if plain else ""
        bags = sorted(source.glob("*.db3")) + sorted(source.glob("*.mcap"))
        if bags:
            also = f"; without metadata.yaml give the bag's file itself, {bags[0].name}"
        raise LogError(
            f"{source}: found no known kind of recording, expected one of: {known}{also}"
        )
    require_table(out, *([source] if source.is_file() else []), *([cell] if cell else []))
    source_options = _options(**options)
    _require_read(kind, source_options)
    opened = open_cell(cell) if cell else None
    converted = kind.read(source, joint_names(opened) if opened else (), source_options)
    if opened is not None:
        converted.log(source, opened.arm.n)  # checks the number of joints
    names, table = converted.table()
    write_table(out, names, table)
    order = ", ".join(f"{i + 1} {name}" for i, name in enumerate(converted.joints))
    click.echo(f"{out}: {len(converted)} rows; joints {order}")
    for note in note_texts(converted.notes):
        click.echo(f"note: {note}")


def _options(
    joints: str | None, topics: tuple[str, ...], wrench: str | None, units: str | None, **same: Any
) -> SourceOptions:
    names = tuple(name.strip() for name in joints.split(",")) if joints else ()
    return SourceOptions(names, _by_role(topics), wrench or "", units=units or "", **same)


def _require_read(kind: Source, options: SourceOptions) -> None:
    """Raise InputError for an option that this kind of source does not read."""
    read = [OPTIONS[name] for name in kind.options]
    for name, option in OPTIONS.items():
        if getattr(options, name) != getattr(SourceOptions(), name) and option not in read:
            expected = f"one of {', '.join(read)}" if read else "none of the kind"
            raise InputError(f"{option}: found with a {kind.title}, expected {expected}")


def _by_role(topics: tuple[str, ...]) -> dict[str, str]:
    roles = {}
    for option in topics:
        role, equals, topic = option.partition("=")
        if not equals or role not in ROLES or not topic:
            raise InputError(
                f"--topic: found {option!r}, expected ROLE=TOPIC, ROLE one of {', '.join(ROLES)}"
            )
        if role in roles:
            raise InputError(f"--topic: found {role} twice, expected it once")
        roles[role] = topic
    return roles
