"""The table of commands: name, location and summary. A new command is one line here."""

from __future__ import annotations

_CELL, _LOG, ROBOT = (f"gapbridge.bridge.cli.{folder}" for folder in ("cell", "log", "robot"))
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (f"{ROBOT}.demo:demo", "Calibrate, compensate and diagnose a simulated cell."),
    "init": (f"{_CELL}.init:init", "Write a cell file from what a controller reports."),
    "check": (f"{_CELL}.check:check", "Check a cell file for mistakes."),
    "diff": (f"{_CELL}.diff:diff", "List the differences of two cells."),
    "simulate": (f"{ROBOT}.simulate:simulate", "Run a simulated controller for a cell."),
    "run": (f"{ROBOT}.run:run", "Run the on-cell daemon."),
    "status": (f"{ROBOT}.status:status", "Show what the daemon of a cell does."),
    "arm": (f"{ROBOT}.arm:arm", "Make the daemon of a cell write setpoints."),
    "disarm": (f"{ROBOT}.arm:disarm", "Make the daemon of a cell ramp out and observe."),
    "calibrate": (
        f"{ROBOT}.calibrate:calibrate",
        "Run a guided calibration session; it can be resumed.",
    ),
    "export": (f"{_LOG}.export:export_recording", "Convert a recording of the daemon to a log."),
    "convert": (f"{_LOG}.convert:convert", "Convert a recording of another program to a log."),
    "fit": (f"{_LOG}.fit:fit", "Identify the compliance of a cell from a log."),
    "predict": (f"{_LOG}.predict:predict", "Predict the TCP pose of every row of a log."),
    "compensate": (f"{_LOG}.compensate:compensate", "Correct the setpoint of every row of a log."),
    "diagnose": (f"{_LOG}.diagnose:diagnose", "Diagnose the sim-to-real gap of a log."),
    "patch": (f"{_CELL}.patch:patch", "Write a cell's effects into a simulator's model."),
    "fleet": (f"{_LOG}.fleet:fleet", "Diagnose or fit many arms over many sessions."),
    "blind": (f"{_LOG}.blind:blind", "Run the blind benchmark of the diagnosis."),
    "explain": (f"{_CELL}.explain:explain", "Explain an effect of the catalogue."),
}
