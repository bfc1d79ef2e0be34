"""The logs by name: which may be looked at while rules are set, and what was published on them.

Half are held back: no rule is set by looking at them. Logs that are unknown here are run all the
same, as held back.
"""

from __future__ import annotations

from dataclasses import dataclass

TUNE, HELD_BACK = "tune", "held back"


@dataclass(frozen=True)
class Published:
    """An outcome reported by the authors of a set; m, mean length of the error vector."""

    mean_length: float
    what: str


SPLIT = {
    "ipa_ur10_a": TUNE, "ipa_ur10_b": TUNE, "ur10_c": TUNE, "ur10_d": TUNE,
    "tsinghua_ur5_grid": TUNE, "tsinghua_ur5_random": HELD_BACK,
    "barrett_wam_grid": TUNE, "barrett_wam_random": HELD_BACK,
    "iiwa_three_loads": TUNE, "iiwa_0kg": TUNE, "iiwa_month_before": HELD_BACK,
    "motoman_cube": TUNE, "motoman_wide": HELD_BACK, "irb120": HELD_BACK,
    "tx2_calibration": TUNE, "tx2_points": TUNE, "tx2_line": HELD_BACK,
    "tx2_curve": HELD_BACK, "tx2_surface": HELD_BACK, "irb120_position_only": TUNE,
    "rokae_30": HELD_BACK,
    "force_sensor_100": TUNE,
    "ur10e_12harmonics": TUNE, "ur10e_50s": TUNE, "ur10e_8harmonics": TUNE,
    "ur10e_point_to_point": TUNE, "rad_ur3e_rtde": TUNE, "panda": TUNE,
    "ur5e_motion": TUNE, "tx40": TUNE,
    "kr300_a": HELD_BACK, "kr300_b": HELD_BACK, "kr300_c": TUNE,
    "ur10_excitation": TUNE, "aubo_i5_torques_1": TUNE, "m1013_high_on_pallet": TUNE,
}  # fmt: skip
PUBLISHED = {
    "tsinghua_ur5_grid > tsinghua_ur5_random": Published(0.1549e-3, "hybrid MDH and ASTGCN"),
    "barrett_wam_grid > barrett_wam_random": Published(2.9178e-3, "hybrid"),
}
# what is found in the first is judged on the second, whole; the frame alone is fitted anew there
CARRIED = (
    ("ipa_ur10_a", "ipa_ur10_b"), ("ipa_ur10_a", "ur10_c"), ("ipa_ur10_a", "ur10_d"),
    ("tsinghua_ur5_grid", "tsinghua_ur5_random"), ("barrett_wam_grid", "barrett_wam_random"),
    ("ur10e_12harmonics", "ur10e_50s"), ("ur10e_12harmonics", "ur10e_point_to_point"),
    ("kr300_a", "kr300_b"), ("meca500_right", "meca500_left"),
    ("aubo_i5_0918", "aubo_i5_0921"), ("aubo_i5_torques_1", "aubo_i5_torques_2"),
)  # fmt: skip
REMOUNTED = {
    "iiwa_three_loads",
    "irb120_position_only",
    "qkm",
}  # logs whose sessions have a tool point of their own
"""Sets whose sessions were measured with the tool mounted anew."""
