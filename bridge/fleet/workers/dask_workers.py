"""Workers of a Dask cluster that somebody else runs.

Dask does a dead worker's tasks again by itself. How often it tries is a setting of the cluster, and
it also counts tasks that only waited on that worker; so each session's starts are counted on the
scheduler, and one that has taken two workers along is not begun a third time.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gapbridge.bridge.fleet.task import CRASHED, DEATHS, Outcome, Task, died, outcome, perform
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.core.errors import RunError

if TYPE_CHECKING:
    from distributed import Client

AHEAD = 4  # tasks per thread that lie at the cluster: enough that none of its threads ever waits
FEWEST_AHEAD = 200
REACH = 10.0  # s to reach the scheduler, and to wait for its first worker


class DaskWorkers(Workers):
    """The workers behind a scheduler's address."""

    def __init__(self, address: str, reach: float = REACH) -> None:
        self.address = address
        self.reach = reach
        self._client: Client | None = None
        self._run = uuid.uuid4().hex[:12]

    def description(self) -> str:
        """Return which cluster it is."""
        return f"the Dask cluster at {self.address}"

    def start(self) -> None:
        """Reach the scheduler; raises RunError where that or the extra is missing."""
        try:
            from distributed import Client
        except ModuleNotFoundError as error:
            raise RunError(
                f"--scheduler: found no package {error.name} in this installation, expected the "
                "extra 'fleet': pip install 'gapbridge[fleet]'"
            ) from None
        # its workers come and go: what matters of that is in the outcomes
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            self._client = Client(self.address, timeout=self.reach, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            self._client = None
            raise RunError(
                f"--scheduler: {self.address}: found no Dask scheduler there, expected one "
                f"({' '.join(str(error).split())[:200]})"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=self.reach)
        except TimeoutError:
            self.stop()
            raise RunError(
                f"--scheduler: {self.address}: found no worker within {self.reach:g} s, expected "
                "one"
            ) from None

    def stop(self) -> None:
        """Leave the cluster; what still lies there is forgotten by it."""
        if self._client is not None:
            self._client.close(timeout=5)
            self._client = None

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Give the outcomes as they come."""
        from distributed import as_completed

        client = self._client
        assert client is not None
        source = iter(tasks)
        waiting: dict[str, Task] = {}
        coming = as_completed(loop=client.loop)
        for _ in range(self._ahead(client)):
            self._send(client, next(source, None), waiting, coming)
        while waiting:
            future = next(coming)
            task = waiting.pop(future.key)
            yield self._outcome(client, future, task)
            future.release()
            self._send(client, next(source, None), waiting, coming)

    def _ahead(self, client: Client) -> int:
        threads = int(sum(client.nthreads().values()))
        return max(FEWEST_AHEAD, AHEAD * threads)

    def _send(
        self, client: Client, task: Task | None, waiting: dict[str, Task], coming: Any
    ) -> None:
        if task is None:
            return
        # a worker's folder is another than ours
        there = replace(task, log=task.log.absolute(), cell=task.cell.absolute())
        key = f"gapbridge-{self._run}-{task.key}"
        future = client.submit(_guarded, there, key, key=key, pure=False)
        waiting[key] = task
        coming.add(future)

    def _outcome(self, client: Client, future: Any, task: Task) -> Outcome:
        if future.status == "finished":
            found: Outcome = future.result()
            return found
        if future.status != "error":
            raise RunError(
                f"{self.address}: the cluster has dropped {future.key} ({future.status}); what was "
                "done is kept, run the command again to go on"
            )
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            return died(task)
        if isinstance(error, ImportError):
            raise RunError(
                f"{self.address}: found workers that cannot import what they need ({error}), "
                "expected gapbridge to be installed there"
            )
        text = " ".join(str(error).split()) or "no message"
        return outcome(task, CRASHED, error=f"{task.log}: {type(error).__name__}: {text}")


def _guarded(task: Task, key: str) -> Outcome:
    """Do a task on a worker, unless it has taken two workers along."""
    from distributed import Queue

    starts = Queue(key)
    try:
        if starts.qsize() >= DEATHS:
            return died(task)
        starts.put(1)
        return perform(task)
    finally:
        starts.close()  # not reached where the worker dies: then the count stays
