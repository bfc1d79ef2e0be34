"""The table of commands: name, where it lives, its one line. A new command is one line here."""

from __future__ import annotations

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (
        "gapbridge.bridge.cli.demo:demo",
        "Do the whole job on a simulated cell, no hardware.",
    ),
    "init": (
        "gapbridge.bridge.cli.init:init",
        "Write a cell from what a controller says of itself.",
    ),
    "check": ("gapbridge.bridge.cli.check:check", "Say whether a cell is fit to be used."),
    "diff": ("gapbridge.bridge.cli.diff:diff", "Say what changed from one cell to another."),
    "simulate": (
        "gapbridge.bridge.cli.simulate:simulate",
        "Serve the simulated controller of a cell.",
    ),
    "run": ("gapbridge.bridge.cli.run:run", "Run the on-cell daemon."),
    "status": ("gapbridge.bridge.cli.status:status", "Report what the daemon of a cell does."),
    "arm": ("gapbridge.bridge.cli.arm:arm", "Have the daemon of a cell write setpoints."),
    "disarm": (
        "gapbridge.bridge.cli.arm:disarm",
        "Have the daemon of a cell ramp out and observe.",
    ),
    "calibrate": (
        "gapbridge.bridge.cli.calibrate:calibrate",
        "Lead a field calibration session; it can be resumed.",
    ),
    "export": (
        "gapbridge.bridge.cli.export:export_recording",
        "Turn a recording of the daemon into a log.",
    ),
    "convert": (
        "gapbridge.bridge.cli.convert:convert",
        "Turn a recording of another program into a log.",
    ),
    "fit": ("gapbridge.bridge.cli.fit:fit", "Identify the compliance of a cell from a log."),
    "predict": (
        "gapbridge.bridge.cli.predict:predict",
        "Predict the TCP pose of every row of a log.",
    ),
    "compensate": (
        "gapbridge.bridge.cli.compensate:compensate",
        "Correct the setpoint of every row of a log.",
    ),
    "diagnose": (
        "gapbridge.bridge.cli.diagnose:diagnose",
        "Diagnose the sim-to-real gap of a log.",
    ),
    "patch": (
        "gapbridge.bridge.cli.patch:patch",
        "Write a cell's effects into a simulator's model.",
    ),
    "fleet": ("gapbridge.bridge.cli.fleet:fleet", "Diagnose or fit many arms over many sessions."),
    "blind": ("gapbridge.bridge.cli.blind:blind", "Run the blind benchmark of the diagnosis."),
    "explain": ("gapbridge.bridge.cli.explain:explain", "Explain an effect of the catalogue."),
}
