"""Times SetpointStream.advance inside the daemon's loop; Python loads it where it is on the path.

The loop is a process of its own that the daemon starts, and that leaves without farewell: the times
go into a file that ``benchmarks.speed.loop`` has made and reads afterwards.
"""

import os
import sys

if "bridge.loop_main" in sys.orig_argv and "ADVANCE_TIMES" in os.environ:
    import time

    import numpy as np

    from bridge.setpoint_stream import SetpointStream

    taken = np.memmap(os.environ["ADVANCE_TIMES"], dtype=np.float64, mode="r+")
    taken[:] = 0.0  # all pages are there before the loop begins
    advance, now, size = SetpointStream.advance, time.perf_counter, len(taken)
    count = 0

    def timed(self, *args, **named):  # type: ignore[no-untyped-def]
        """Do what ``advance`` does, and write down how long it took, s."""
        global count
        begin = now()
        found = advance(self, *args, **named)
        taken[count] = now() - begin
        count = (count + 1) % size
        return found

    SetpointStream.advance = timed  # type: ignore[method-assign]
