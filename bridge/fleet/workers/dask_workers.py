"""Workers of a running Dask cluster.

Dask repeats the tasks of a dead worker. Its limit is a setting of the cluster and also counts tasks
that only waited on that worker; so the starts of each session are counted on the scheduler, and a
session that has killed two workers is not started again.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gapbridge.bridge.fleet.task import CRASHED, MAX_DEATHS, Outcome, Task, run_task
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.core.errors import RunError

if TYPE_CHECKING:
    from distributed import Client

QUEUED_PER_THREAD = 4  # tasks at the cluster, so that no thread waits
MIN_QUEUED = 200
CONNECT_TIMEOUT = 10.0  # s for the scheduler, and for its first worker


class DaskWorkers(Workers):
    """The workers of the cluster at a scheduler's address."""

    def __init__(self, address: str, timeout: float = CONNECT_TIMEOUT) -> None:
        self.address = address
        self.timeout = timeout
        self._client: Client | None = None
        self._run = uuid.uuid4().hex[:12]

    def description(self) -> str:
        """Return the address of the cluster."""
        return f"the Dask cluster at {self.address}"

    def start(self) -> None:
        """Connect to the scheduler; raises RunError without scheduler, worker or package."""
        try:
            from distributed import Client
        except ModuleNotFoundError as error:
            raise RunError(
                f"--scheduler: found no package {error.name} in this installation, expected the "
                "extra 'fleet': pip install 'gapbridge[fleet]'"
            ) from None
        # losses of workers are reported as outcomes
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            self._client = Client(self.address, timeout=self.timeout, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            self._client = None
            raise RunError(
                f"--scheduler: {self.address}: found no Dask scheduler there, expected one "
                f"({' '.join(str(error).split())[:200]})"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=self.timeout)
        except TimeoutError:
            self.stop()
            raise RunError(
                f"--scheduler: {self.address}: found no worker within {self.timeout:g} s, expected "
                "one"
            ) from None

    def stop(self) -> None:
        """Disconnect; the cluster drops unfinished tasks."""
        if self._client is not None:
            self._client.close(timeout=5)
            self._client = None

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Yield the outcomes as they finish."""
        from distributed import as_completed

        client = self._client
        assert client is not None
        source = iter(tasks)
        waiting: dict[str, Task] = {}
        futures = as_completed(loop=client.loop)
        for _ in range(self._queue_length(client)):
            self._send(client, next(source, None), waiting, futures)
        while waiting:
            future = next(futures)
            task = waiting.pop(future.key)
            yield self._outcome(client, future, task)
            future.release()
            self._send(client, next(source, None), waiting, futures)

    def _queue_length(self, client: Client) -> int:
        threads = int(sum(client.nthreads().values()))
        return max(MIN_QUEUED, QUEUED_PER_THREAD * threads)

    def _send(
        self, client: Client, task: Task | None, waiting: dict[str, Task], futures: Any
    ) -> None:
        if task is None:
            return
        # workers have another working directory
        remote = replace(task, log=task.log.absolute(), cell=task.cell.absolute())
        key = f"gapbridge-{self._run}-{task.key}"
        future = client.submit(_run_counted, remote, key, key=key, pure=False)
        waiting[key] = task
        futures.add(future)

    def _outcome(self, client: Client, future: Any, task: Task) -> Outcome:
        if future.status == "finished":
            result: Outcome = future.result()
            return result
        if future.status != "error":
            raise RunError(
                f"{self.address}: the cluster has dropped {future.key} ({future.status}); finished "
                "sessions are saved, rerun the command to resume"
            )
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            return task.died_outcome()
        if isinstance(error, ImportError):
            raise RunError(
                f"{self.address}: found workers that cannot import what they need ({error}), "
                "expected gapbridge to be installed there"
            )
        text = " ".join(str(error).split()) or "no message"
        return task.outcome(CRASHED, error=f"{task.log}: {type(error).__name__}: {text}")


def _run_counted(task: Task, key: str) -> Outcome:
    """Run a task on a worker, unless it has killed MAX_DEATHS workers."""
    from distributed import Queue

    starts = Queue(key)
    try:
        if starts.qsize() >= MAX_DEATHS:
            return task.died_outcome()
        starts.put(1)
        return run_task(task)
    finally:
        starts.close()  # not reached if the worker dies: the count is kept
