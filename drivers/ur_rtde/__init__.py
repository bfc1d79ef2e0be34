"""Universal Robots arms over RTDE, with the ur_rtde library."""
