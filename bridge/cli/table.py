"""The table of commands: name, where it lives, its one line. A new command is one line here."""

from __future__ import annotations

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("bridge.cli.demo:demo", "Do the whole job on a simulated cell, no hardware."),
    "init": ("bridge.cli.init:init", "Write a cell from what a controller says of itself."),
    "check": ("bridge.cli.check:check", "Say whether a cell is fit to be used."),
    "diff": ("bridge.cli.diff:diff", "Say what changed from one cell to another."),
    "simulate": ("bridge.cli.simulate:simulate", "Serve the simulated controller of a cell."),
    "run": ("bridge.cli.run:run", "Run the on-cell daemon."),
    "status": ("bridge.cli.status:status", "Tell what the daemon of a cell does."),
    "arm": ("bridge.cli.arm:arm", "Have the daemon of a cell write setpoints."),
    "disarm": ("bridge.cli.arm:disarm", "Have the daemon of a cell ramp out and observe."),
    "calibrate": (
        "bridge.cli.calibrate:calibrate",
        "Lead a field calibration session; it can be resumed.",
    ),
    "export": (
        "bridge.cli.export:export_recording",
        "Turn a recording of the daemon into a log.",
    ),
    "convert": (
        "bridge.cli.convert:convert",
        "Turn a recording of another program into a log.",
    ),
    "fit": ("bridge.cli.fit:fit", "Identify the compliance of a cell from a log."),
    "predict": ("bridge.cli.predict:predict", "Predict the TCP pose of every row of a log."),
    "compensate": (
        "bridge.cli.compensate:compensate",
        "Correct the setpoint of every row of a log.",
    ),
    "diagnose": ("bridge.cli.diagnose:diagnose", "Diagnose the sim-to-real gap of a log."),
    "patch": (
        "bridge.cli.patch:patch",
        "Write a cell's effects into a simulator's model.",
    ),
    "fleet": ("bridge.cli.fleet:fleet", "Diagnose or fit many arms over many sessions."),
    "blind": ("bridge.cli.blind:blind", "Run the blind benchmark of the diagnosis."),
    "explain": ("bridge.cli.explain:explain", "Explain an effect of the catalogue."),
}
