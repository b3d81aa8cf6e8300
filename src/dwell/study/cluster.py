"""Parallel execution of one task on many units, by the workers of a Dask cluster.

`dwell.study.workers.spread` does the same with local processes. The workers need this package in
the same version, but no files of this machine: results return as they are ready, and this process
writes them.
"""

from __future__ import annotations

import asyncio
import logging
import operator
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TypeVar

from dwell.errors import SimulationError, installing

Unit = TypeVar("Unit")
Result = TypeVar("Result")

#: How long a scheduler may take to answer, and its first worker to come, seconds.
ANSWER_S = 10.0
WORKER_S = 30.0


def spread_on_dask(
    task: Callable[[Unit], Result],
    units: Sequence[Unit],
    *,
    address: str,
    take: Callable[[Unit, Result], None],
    rest: Callable[[Result], Unit | None] = lambda _: None,
) -> None:
    """Do a task on every unit.

    Parameters
    ----------
    task : callable
        It, the units and the results must pickle.
    address : str
        The scheduler's, as ``tcp://host:8786``.
    take : callable
        Called in this process with each unit and its result, as soon as that is ready.
    rest : callable
        Returns the part of a unit that its result leaves open, which is then a further unit.

    Raises
    ------
    SimulationError
        If Dask is not installed, no scheduler answers, it has no workers, or they are lost.
    """
    dask = _distributed()
    with _quiet():
        client = _connect(dask, address)

        def send(those: Sequence[Unit]) -> dict[Any, Unit]:
            futures = client.map(operator.call, [everywhere] * len(those), those, pure=False)
            return dict(zip(futures, those, strict=True))

        try:
            # Sent to each worker once, like the task of a local process.
            everywhere = client.scatter(task, broadcast=True, hash=False)
            waiting = send(units)
            ready = dask.as_completed(list(waiting), loop=client.loop)
            for future in ready:
                unit, result = waiting.pop(future), future.result()
                take(unit, result)
                if (left := rest(result)) is not None:
                    waiting |= (more := send([left]))
                    ready.update(more)
        except dask.KilledWorker:
            raise SimulationError(
                "workers of the Dask cluster ended again and again before their work was done; "
                "look at their logs, and at their memory"
            ) from None
        except dask.client.FutureCancelledError:
            raise SimulationError(
                "the Dask cluster was lost on the way: its scheduler, or all of its workers at a "
                "time"
            ) from None
        finally:
            # The scheduler drops the waiting units, because no other client needs them.
            client.close(timeout=ANSWER_S)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence a client's log of tracebacks; the caller raises a single error."""
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _distributed() -> Any:
    """Return the package, whose functions have no types."""
    try:
        return import_module("distributed")
    except ImportError:
        raise SimulationError(
            "a Dask cluster needs the package `distributed`, which is not installed; "
            f"{installing('dask')}"
        ) from None


def _connect(dask: Any, address: str) -> Any:
    """Return a client of the scheduler, once it has a worker."""
    _ask(dask, address)
    client = dask.Client(address, timeout=ANSWER_S, set_as_default=False)
    try:
        client.wait_for_workers(1, timeout=WORKER_S)
    except TimeoutError:
        client.close(timeout=ANSWER_S)
        raise SimulationError(
            f"the Dask scheduler at {address} has no workers; start one with "
            f"`dask worker {address} --nthreads 1`"
        ) from None
    return client


def _ask(dask: Any, address: str) -> None:
    """Raise unless a scheduler answers: a client that finds none is slow and loud about it."""

    async def identity() -> Any:
        async with dask.rpc(address) as scheduler:
            return await scheduler.identity()

    # In a separate thread, because a notebook runs its own event loop in this thread.
    with ThreadPoolExecutor(1) as thread:
        try:
            found = thread.submit(asyncio.run, asyncio.wait_for(identity(), ANSWER_S)).result()
        except Exception as error:  # whatever else listens there may answer anything
            said = str(error).splitlines() or [type(error).__name__]
            raise SimulationError(
                f"no Dask scheduler answers at {address!r} ({said[0]}); start one with "
                "`dask scheduler`, or check the address"
            ) from None
    if found.get("type") != "Scheduler":
        raise SimulationError(f"{address} is a Dask {found.get('type')}; name the scheduler")
