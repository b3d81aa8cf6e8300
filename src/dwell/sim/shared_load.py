"""Load of the nodes that the cells of a fleet share, over time."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from dwell.model.number_arrays import Floats
from dwell.sim.tables import PlayedRealisation


def shared_load(
    played: Mapping[str, PlayedRealisation], shared: Collection[str]
) -> dict[str, NDArray[np.generic]]:
    """Return the load of shared nodes in equal windows, as long as the shortest window of a cell.

    The windows are independent of the cells' windows: they begin at time 0 and end before the first
    cell ends. The work done by each resource is known at the start and end of the cells' windows
    and interpolated in between.

    The result has ``window``, ``start_ns``, and for every shared resource ``u_RESOURCE``, its
    utilisation, and ``own_RESOURCE_CELL``, the share that a cell and its shadow used; all arrays
    have the shape (windows,).
    """
    problem = min((one.problem for one in played.values()), key=lambda one: one.window_ms)
    window_ns = problem.window_ms * 1e6
    end_ns = min(one.close_ns[-1] if len(one.first) else 0 for one in played.values())
    count = int(end_ns // window_ns)
    edges_ns: Floats = window_ns * np.arange(count + 1, dtype=np.float64)
    columns: dict[str, NDArray[np.generic]] = {
        "window": np.arange(count),
        "start_ns": edges_ns[:-1].round().astype(np.int64),
    }
    known = {name: _snapshots(one) for name, one in played.items()}
    resources = problem.fabric.resources
    for resource in resources.values():
        if resource.node not in shared:
            continue
        whole_ns = resource.capacity * window_ns
        places = {
            name: [*one.problem.fabric.resources].index(resource.name)
            for name, one in played.items()
        }
        at = np.concatenate([known[name][0] for name in played])
        busy = np.concatenate([known[name][1][:, 0, places[name]] for name in played])
        columns[f"u_{resource.name}"] = _share(edges_ns, at, busy, whole_ns)
        for name, (at, done) in known.items():
            own = done[:, 1:3, places[name]].sum(axis=1)
            columns[f"own_{resource.name}_{name}"] = _share(edges_ns, at, own, whole_ns)
    return columns


def _snapshots(of: PlayedRealisation) -> tuple[Floats, Floats]:
    """Return instants and the core-nanoseconds done until then, shape (instants, 4, resources)."""
    count = len(of.first)
    at = np.concatenate([of.realisation.release_ns[of.first], of.close_ns]).astype(np.float64)
    tables = of.arrays.tables
    return at, np.concatenate([tables.opened[0, :count], tables.closed[0, :count]])


def _share(edges_ns: Floats, at: Floats, done: Floats, whole_ns: float) -> Floats:
    """Return the used share of a resource's capacity between successive edges."""
    order = np.argsort(at, kind="stable")
    return np.diff(np.interp(edges_ns, at[order], done[order], left=0.0)) / whole_ns
