"""Parallel execution of one task on many units, in worker processes.

Results arrive in any order, each with its unit. The caller sorts them, so its result does not
depend on the number or the speed of processes. Processes are spawned, because a fork of a process
with threads may deadlock. Each process receives the task once and shares no other state. Workers
end with their parent process, even if the parent is killed.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from queue import SimpleQueue
from types import FunctionType
from typing import Any, TypeVar, cast

from dwell.errors import PolicyError, SimulationError, describe_raised, user_note

Unit = TypeVar("Unit")
Result = TypeVar("Result")

#: One process per CPU: threads of libraries inside would only compete with each other.
SINGLE_THREADED = {"OPENBLAS_NUM_THREADS": "1", "POLARS_MAX_THREADS": "1"}


def available_processes() -> int:
    """CPUs that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def spread(
    task: Callable[[Unit], Result],
    units: Sequence[Unit],
    *,
    processes: int,
    take: Callable[[Unit, Result], bool | None],
    rest: Callable[[Result], Unit | None] = lambda _: None,
) -> None:
    """Run a task on every unit, until `take` returns True.

    Parameters
    ----------
    task : callable
        The task, the units and the results must pickle.
    units : sequence
        Hashable and unique.
    processes : int
        Number of worker processes; 1 runs the task in this process. With more, a script must begin
        its work under ``if __name__ == "__main__":``, because every process imports the script.
    take : callable
        Called in this process with each unit and its result, as soon as the result is ready. If it
        returns True, the remaining units are dropped.
    rest : callable
        Returns the unfinished part of a unit from its result; the part becomes a further unit.

    Raises
    ------
    SimulationError
        If a process ended before its work was done.
    """
    if min(processes, len(units)) <= 1:
        queue = deque(units)
        while queue:
            unit = queue.popleft()
            result = task(unit)
            if take(unit, result):
                break
            if (left := rest(result)) is not None:
                queue.appendleft(left)
        return
    pool = ProcessPoolExecutor(
        max_workers=min(processes, len(units)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(task,),
    )
    waiting: dict[Future[object], Unit] = {}
    ready: SimpleQueue[Future[object]] = SimpleQueue()

    def submit(those: Sequence[Unit]) -> None:
        with _as_for_workers():
            for unit in those:
                future = pool.submit(_work, unit)
                waiting[future] = unit
                future.add_done_callback(ready.put)

    try:
        submit(units)
        while waiting:
            future = ready.get()
            # Removed from `waiting` to free the result, which the future references.
            unit, result = waiting.pop(future), cast("Result", future.result())
            if take(unit, result):
                break
            if (left := rest(result)) is not None:
                submit([left])
    except BrokenProcessPool:
        raise SimulationError(
            "a worker process ended before its work was done: out of memory, killed, or a script "
            'without `if __name__ == "__main__":`; ask for 1 process to work without them'
        ) from None
    finally:
        # On an interrupt or an error: cancel waiting units, finish running ones, end the workers.
        pool.shutdown(wait=True, cancel_futures=True)


def require_importable(objects: Mapping[str, object]) -> None:
    """Refuse objects that cannot be sent to worker processes.

    Parameters
    ----------
    objects : mapping of str to object
        Objects by their names in messages.

    Raises
    ------
    SimulationError
        If an object does not pickle, or its class is in no module.
    """
    for name, given in objects.items():
        try:
            _Sender(io.BytesIO()).dump(given)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise SimulationError(
                f"{name} cannot be sent to worker processes: it does not pickle ({error}); change "
                "that, or processes=1"
            ) from None


class _Sender(pickle.Pickler):
    """A pickler that refuses classes and functions of a notebook or script."""

    def reducer_override(self, one: object) -> Any:
        if isinstance(one, type | FunctionType) and one.__module__ == "__main__":
            raise SimulationError(
                f"{one.__qualname__} is defined in a notebook or script (__main__); put it into a "
                "module, or processes=1"
            )
        return NotImplemented


class _Worker:
    """Task of a worker process; pickling loses its static type."""

    task: Callable[..., object]


def _begin(task: Callable[..., object]) -> None:
    """Prepare a worker process."""
    _Worker.task = task
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(unit: object) -> object:
    """Run the task on a unit, in a worker process."""
    try:
        return _Worker.task(unit)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))  # noqa: S301 - made here
        except Exception:
            # The parent process could not unpickle the error.
            raise PolicyError(user_note(error) or describe_raised(error)) from None
        raise


@contextmanager
def _as_for_workers() -> Iterator[None]:
    """Start processes in this context with one thread, and without Ctrl-C: the parent handles it.

    The variables must be set before the start, because NumPy reads them when it is imported.
    """
    before = {name: os.environ[name] for name in SINGLE_THREADED if name in os.environ}
    os.environ.update(SINGLE_THREADED)
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGINT, handler)
        for name in SINGLE_THREADED:
            del os.environ[name]
        os.environ.update(before)
