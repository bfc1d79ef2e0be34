"""Tables of a fleet's results, as Parquet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gapbridge.bridge.document.output_file import replacing_bytes
from gapbridge.bridge.fleet.task import Outcome

RESULTS, SESSIONS = "results.parquet", "sessions.parquet"
CHANNELS = ("position", "wrench", "tracking", "torque")
FIGURES = {"gap_rms": "float64", "gap_max": "float64", "noise_floor_rms": "float64",
           "remaining_rms": "float64", "remaining_rms_held_out": "float64"}  # fmt: skip
SESSION = {
    "arm": "string", "session": "string", "type": "string", "log": "string", "cell": "string",
    "state": "string", "error": "string", "seconds": "float64", "processor": "float64",
    "time": "float64", "poses": "int64", "joints": "int64",
}  # fmt: skip
EFFECT = {
    "arm": "string", "session": "string", "type": "string", "time": "float64",
    "channel": "string", "effect": "string", "accused": "bool", "joints": "list<int64>",
    "parameter": "string", "value": "float64", "std": "float64", "unit": "string",
    "probability": "float64", "shrink": "float64", "shrink_low": "float64",
    "shrink_high": "float64", "shrink_alone": "float64",
    "indistinguishable_from": "list<string>",
}  # fmt: skip
DIAGNOSED = {
    **SESSION, "verdict": "string",
    **{f"{c}_{f}": kind for c in CHANNELS
       for f, kind in {"verdict": "string", "samples": "int64", **FIGURES}.items()},
}  # fmt: skip
FLEXIBILITY = {
    "level": "string", "type": "string", "arm": "string", "session": "string",
    "parameter": "string", "joint": "int64", "value": "float64", "std": "float64",
    "low": "float64", "high": "float64", "unit": "string", "shown": "bool",
    "scatter": "float64", "own_share": "float64", "drift": "float64", "drift_std": "float64",
    "drift_per": "string",
}  # fmt: skip
FITTED = {
    **SESSION, "outliers": "int64", "noise": "float64", "gap_before": "float64",
    "gap_after": "float64", "gap_held_out": "float64", "surprise": "float64",
}  # fmt: skip


def write_parquet(
    path: Path, columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]]
) -> Path:
    """Write rows under typed columns in one step; what a row lacks is null."""
    import pyarrow
    from pyarrow import parquet

    schema = pyarrow.schema([(name, _kind(pyarrow, kind)) for name, kind in columns.items()])
    table = pyarrow.Table.from_pylist(list(rows), schema=schema)
    with replacing_bytes(path) as file:
        parquet.write_table(table, file, compression="zstd")
    return path


def session_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Give a row per session, usable or not."""
    for outcome in outcomes:
        row = {name: getattr(outcome, name) for name in
               ("arm", "session", "log", "cell", "state", "error", "seconds",
                "processor")}  # fmt: skip
        names = ("type", "time", "poses", "joints")
        yield row | {name: outcome.result.get(name) for name in names}


def diagnosed_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Give a row per session with its channels' figures."""
    for row, outcome in zip(session_rows(outcomes), outcomes, strict=True):
        figures = {
            f"{channel['channel']}_{name}": channel[name]
            for channel in outcome.result.get("channels", ())
            for name in ("verdict", "samples", *FIGURES)
        }
        yield row | {"verdict": outcome.result.get("verdict")} | figures


def effect_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Give a row per session and parameter of an accused effect, and per effect looked at."""
    for outcome in outcomes:
        shared = {"arm": outcome.arm, "session": outcome.session,
                  "type": outcome.result.get("type"),
                  "time": outcome.result.get("time")}  # fmt: skip
        for row in outcome.result.get("rows", ()):
            yield shared | dict(row)


def _kind(pyarrow: Any, kind: str) -> Any:
    if kind.startswith("list<"):
        return pyarrow.list_(pyarrow.type_for_alias(kind[5:-1]))
    return pyarrow.type_for_alias(kind)
