"""Times SetpointStream.advance inside the daemon's loop; Python loads it where it is on the path.

The loop is a process of its own that the daemon starts, and that leaves without farewell: the times
go into a file that ``benchmarks.speed.loop`` has made and reads afterwards.
"""

import os
import sys

if "gapbridge.bridge.loop.main" in sys.orig_argv and "ADVANCE_TIMES" in os.environ:
    import time

    import numpy as np

    from gapbridge.bridge.loop.setpoint_stream import SetpointStream

    taken = np.memmap(os.environ["ADVANCE_TIMES"], dtype=np.float64, mode="r+").reshape(-1, 2)
    taken[:] = 0.0  # all pages are there before the loop begins
    advance, size = SetpointStream.advance, len(taken)
    now, busy = time.perf_counter, time.thread_time
    count = 0

    def timed(self, *args, **named):  # type: ignore[no-untyped-def]
        """Do what ``advance`` does, and write down how long it took: wall and CPU time, s."""
        global count
        worked, begin = busy(), now()
        found = advance(self, *args, **named)
        taken[count] = now() - begin, busy() - worked
        count = (count + 1) % size
        return found

    SetpointStream.advance = timed  # type: ignore[method-assign]
