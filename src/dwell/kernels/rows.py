"""Arguments of the kernel: the structs of ``rows.h``, and tables with them as rows."""

from __future__ import annotations

import ctypes
from functools import cache
from itertools import groupby
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.library import foreign
from dwell.model.number_arrays import Floats, Ints
from dwell.model.scenario import RAMP_STEPS

#: Rows of structs, with the fields in `row_types`.
Rows: TypeAlias = NDArray[np.void]
Row: TypeAlias = Any

#: Number of levels of a disturbance: off, and one per step of a ramp.
LEVELS = RAMP_STEPS + 1

#: Types of array arguments of the library's functions: one element type, contiguous.
FLOATS_IN = np.ctypeslib.ndpointer(np.float64, ndim=1, flags="C_CONTIGUOUS")
INTS_OUT, INT_ROWS_OUT, FLOATS_OUT, FLOAT_ROWS_OUT = (
    np.ctypeslib.ndpointer(kind, ndim=ndim, flags=("C_CONTIGUOUS", "WRITEABLE"))
    for kind in (np.int64, np.float64)
    for ndim in (1, 2)
)

#: Types of fields other than structs; a pointer is an address.
PLAIN: dict[str, Any] = {
    "i8": ctypes.c_int8,
    "i16": ctypes.c_int16,
    "i32": ctypes.c_int32,
    "i64": ctypes.c_int64,
    "u64": ctypes.c_uint64,
    "f64": ctypes.c_double,
    "Times": ctypes.c_uint64,
    "Levels": ctypes.c_int64 * LEVELS,
    "Shares": ctypes.c_double * LEVELS,
    "Sfc64": ctypes.c_uint64 * 4,
}


class _Field(ctypes.Structure):
    """A field of a struct."""

    _fields_ = tuple((name, ctypes.c_char_p) for name in ("struct", "name", "type"))


@cache
def structs() -> dict[str, Any]:
    """Return the structs of ``rows.h`` by name: classes of ctypes, and plain types.

    Raises
    ------
    KernelError
        If the library cannot be loaded (see `dwell.kernels.library`).
    """
    describe = foreign("dwell_layout", ctypes.c_int64, ctypes.c_void_p)()
    fields = (_Field * describe(None))()
    describe(fields)
    known = dict(PLAIN)
    for struct, of in groupby(fields, lambda field: field.struct.decode()):
        kinds = [(field.name.decode(), field.type.decode()) for field in of]
        named = [
            (name, ctypes.c_uint64 if kind.endswith("*") else known[kind]) for name, kind in kinds
        ]
        known[struct] = type(struct, (ctypes.Structure,), {"_fields_": named})
    return known


@cache
def row_types() -> dict[str, np.dtype[Any]]:
    """Return the type of the rows of every table, by the table's name, in the kernel's order."""
    return {name: np.dtype(kind) for name, kind in structs()["Tables"]._fields_}


class Tables(NamedTuple):
    """Every array of a simulation, in the kernel's order.

    Fixed tables describe the problem and the realisation. State tables change during the
    simulation. Outputs are tables per cycle and per window, and optional logs. ``rows.h`` declares
    the columns of tables of structs. N is the number of cycles; the dimensions "tasks" and "flows"
    of a cell are maxima over all cells.
    """

    clock: Rows  # (1,)
    cells: Rows  # (cells,)
    # fixed
    tasks: Rows  # (tasks,)
    flows: Rows  # (flows,)
    outputs: NDArray[np.int32]  # flows out of each task, in the order of the file
    sampled: NDArray[np.int32]  # sampled flows of each cell, in the order of the file
    sink_rates: NDArray[np.int32]  # rates of the sinks that each task's outputs are waited for by
    cell_servers: NDArray[np.int32]  # servers of each cell's resources
    capacity: Floats  # cores, or places, of each of these servers
    nodes: Rows  # (nodes,)
    site_of: NDArray[np.int32]  # (candidates, tasks) -> site
    route: NDArray[np.int32]  # (candidates, flows) -> hop, or -1 on the same node
    back_ns: Ints  # (candidates,) time from a completion until the guard learns of it
    shadow_parts: NDArray[np.int8]  # (pairs of candidates, tasks)
    after_ns: Ints  # (candidates,) hold of the second copy, -1 without replicas
    hear_ns: Ints  # (candidates, tasks) time from done until the task's node hears of it; or -1
    hops: Rows  # (hops,)
    forwards: Rows  # (forwards,)
    layers: NDArray[np.uint64]  # (hops, layers) address of the extra delays, 0 for none
    segments: Rows  # (segments,)
    rates: Rows  # (segments,)
    changes: Rows  # (changes,)
    work: Floats  # (candidates, resources) own work; empty, like the next two, without a rule
    switching: Floats  # (candidates, candidates) share of tasks moved
    tiers: NDArray[np.int8]  # (resources,)
    stamps: NDArray[np.int16]  # (cells, N) candidate of each cycle; -1 for a cycle without shadow
    # state
    sites: Rows  # (sites,)
    servers: Rows  # (servers,)
    quotas: Rows  # (servers with a quota,)
    links: Rows  # (links,)
    events: Rows  # the queue, with the next event of the same day, and the first of every day
    following: NDArray[np.int32]
    days: NDArray[np.int32]
    held: Rows  # messages that wait for others, or for their repeat; as many rows as events
    repeats: Rows  # forwards that will be sent again; as many rows as events
    running: Rows  # per server a heap of running jobs by virtual finish
    waiting: Rows  # per server a heap of jobs that wait for cores
    dirty: NDArray[np.int32]  # servers to look after at the end of the event
    ready: Ints  # jobs that the event has made ready
    jobs: Rows  # (cells * slots * tasks,)
    slots: Rows  # (cells * slots,)
    attempts: Ints  # (cells * slots, flows) number of the last lost attempt, from 0
    own_ns: Floats  # (cells, resources of a cell) core-nanoseconds of completed own work
    soonest_ns: Ints  # (candidates, tasks) least time from release to readiness; -1 if unknown
    ages: Ints  # (W,) scratch: latency, or age if unfinished, of the cycles of a window
    values: Ints  # (sites, flows) cycle of the newest message of a sampled input; -1 for none
    forwarded: Ints  # (forwards,) newest cycle that was forwarded; -1 for none
    chains: Rows  # chains of all cells
    descents: Rows  # (cells, N, tasks, chains) oldest and newest cycle that a job descends from
    rule: Rows  # (1,), or empty if Python decides
    options: Rows  # (candidates,)
    shown: Floats  # (resources, candidates) last share under a candidate, kept while full; else 1
    # outputs
    latency_ns: Ints  # (cells, N), NEVER_NS until done
    compute_ns: Ints
    network_ns: Ints
    outcome: NDArray[np.int8]
    late_copies: Ints  # (cells, N) messages that came after the other copy's; or empty
    paid: Floats  # (cells, N) price of all transmissions up to the release; or empty
    actuated_ns: Ints  # (cells, chains, N) completion of a chain's last task, or NEVER_NS
    actuated_from: Ints  # (cells, chains, N) the origin of this actuation
    actuated_newest: Ints  # (cells, chains, N) newest cycle that it descends from, -1 for none
    opened: Floats  # (cells, windows, PARTS, resources) at first releases
    closed: Floats  # (cells, windows, PARTS, resources) at the end of windows
    seen: Rows  # (cells, windows) metrics as known at the end of windows
    shares: Floats  # (cells, windows, PARTS, resources) of the cores or places
    look_opened: Floats  # (cells, looks, 2, PARTS, resources) since the last decision; for W cycles
    look_closed: Floats  # (cells, looks, PARTS, resources) when a decision is due
    looked: Rows  # (cells, looks) metrics of the cycles that a decision looks at
    look_shares: Floats  # (cells, looks, 2, PARTS, resources)
    decided: Rows  # (decisions,)
    priced: (
        Floats  # (decisions, columns) by candidate: J, L95, V_D, U of each node, is within, excess
    )
    shadow_bytes: Ints  # (N,) bytes that the shadow of each cycle sent on links, or empty
    log: Rows  # (cells * L * tasks,), L being N or the slots (`logs_all`); or empty
    log_outcome: NDArray[np.int8]
    log_arrived: Ints  # (cells * L, flows), or empty
    log_taken: Ints  # (cells * L, flows) cycle of each sampled message that a job took, or empty

    def addresses(self) -> NDArray[np.uint64]:
        """Return the address and length of every table.

        Raises TypeError if a table has another row type than the kernel's, or is not contiguous.
        """
        tables: tuple[NDArray[Any], ...] = self
        for (name, kind), table in zip(row_types().items(), tables, strict=True):
            if table.dtype != kind or not table.flags.c_contiguous:
                raise TypeError(f"{name} has rows of {table.dtype}, not of {kind} in one piece")
        return np.array([(table.ctypes.data, table.size) for table in tables], np.uint64)
