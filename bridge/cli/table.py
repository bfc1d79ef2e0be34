"""The table of commands: name, where it lives, its one line. A new command is one line here."""

from __future__ import annotations

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (
        "gapbridge.bridge.cli.robot.demo:demo",
        "Calibrate, compensate and diagnose a simulated cell.",
    ),
    "init": (
        "gapbridge.bridge.cli.cell.init:init",
        "Write a cell file from what a controller reports.",
    ),
    "check": ("gapbridge.bridge.cli.cell.check:check", "Check a cell file for mistakes."),
    "diff": ("gapbridge.bridge.cli.cell.diff:diff", "List the differences of two cells."),
    "simulate": (
        "gapbridge.bridge.cli.robot.simulate:simulate",
        "Run a simulated controller for a cell.",
    ),
    "run": ("gapbridge.bridge.cli.robot.run:run", "Run the on-cell daemon."),
    "status": (
        "gapbridge.bridge.cli.robot.status:status",
        "Show what the daemon of a cell does.",
    ),
    "arm": ("gapbridge.bridge.cli.robot.arm:arm", "Make the daemon of a cell write setpoints."),
    "disarm": (
        "gapbridge.bridge.cli.robot.arm:disarm",
        "Make the daemon of a cell ramp out and observe.",
    ),
    "calibrate": (
        "gapbridge.bridge.cli.robot.calibrate:calibrate",
        "Run a guided calibration session; it can be resumed.",
    ),
    "export": (
        "gapbridge.bridge.cli.log.export:export_recording",
        "Convert a recording of the daemon to a log.",
    ),
    "convert": (
        "gapbridge.bridge.cli.log.convert:convert",
        "Convert a recording of another program to a log.",
    ),
    "fit": ("gapbridge.bridge.cli.log.fit:fit", "Identify the compliance of a cell from a log."),
    "predict": (
        "gapbridge.bridge.cli.log.predict:predict",
        "Predict the TCP pose of every row of a log.",
    ),
    "compensate": (
        "gapbridge.bridge.cli.log.compensate:compensate",
        "Correct the setpoint of every row of a log.",
    ),
    "diagnose": (
        "gapbridge.bridge.cli.log.diagnose:diagnose",
        "Diagnose the sim-to-real gap of a log.",
    ),
    "patch": (
        "gapbridge.bridge.cli.cell.patch:patch",
        "Write a cell's effects into a simulator's model.",
    ),
    "fleet": (
        "gapbridge.bridge.cli.log.fleet:fleet",
        "Diagnose or fit many arms over many sessions.",
    ),
    "blind": ("gapbridge.bridge.cli.log.blind:blind", "Run the blind benchmark of the diagnosis."),
    "explain": ("gapbridge.bridge.cli.cell.explain:explain", "Explain an effect of the catalogue."),
}
