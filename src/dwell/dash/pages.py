"""Pages of `dwell dash`: a run, two runs, the runs of a fleet or of a folder, or a live cell."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dwell.errors import DwellError, RunError, TrustError
from dwell.live.log import printable, say
from dwell.record import is_fleet, is_run

if TYPE_CHECKING:
    from dwell.dash.observer import Observer
    from dwell.dash.server import Dash


def recorded_page(folder: Path, beside: Path | None) -> Dash:
    """Read a recorded run, two runs on one time line, the runs of a fleet, or a folder of runs.

    Raises `RunError` if a folder has none of these or is damaged, or if all runs of a fleet are
    incomplete.
    """
    with ThreadPoolExecutor(1) as reader:
        reading = reader.submit(_read, folder, beside)
        # Import the server while the other thread reads; both take equally long.
        from dwell.dash.server import Dash

        return Dash(**reading.result())


def _require_run(folder: Path) -> None:
    """Refuse a fleet, or a folder without a run."""
    if is_run(folder) or not folder.is_dir():
        return
    if is_fleet(folder):
        raise RunError(f"{folder}: a fleet; name the folder of one of its cells")
    raise RunError(f"{folder}: not a run; --beside compares two folders with one run each")


def _read(folder: Path, beside: Path | None) -> dict[str, Any]:
    """Return a fleet, a folder of runs, or one or two runs with the unit of their time line."""
    if is_fleet(folder):
        from dwell.dash.recorded_fleet import RecordedFleet

        return {"fleet": RecordedFleet(folder)}
    if beside is None and folder.is_dir() and not is_run(folder):
        from dwell.dash.runs_folder import RunsFolder

        runs = RunsFolder(folder)
        runs.start()
        return {"runs": runs}
    for path in filter(None, (folder, beside)):
        _require_run(path)
    from dwell.dash.recorded_cell import RecordedCell, difference, same_realisation

    one = RecordedCell(folder)
    if beside is None:
        return {"cells": [one]}
    other = RecordedCell(beside)
    line = "by seconds since the first release: the runs met different realisations"
    if same_realisation(one.run, other.run):
        one, other = RecordedCell(folder, "cycle"), RecordedCell(beside, "cycle")
        line = "by number of the cycle: both runs met the same realisation"
    return {"cells": [one, other], "line": line, "difference": partial(difference, one, other)}


@contextmanager
def live_page(
    file: Path,
    environment: Mapping[str, str],
    *,
    control: bool,
    mcap: Path | None = None,
) -> Iterator[Dash]:
    """Observe a live cell, and record it to a new file `mcap` if that is given.

    `environment` has the variables of `dwell.live.host.security`; `control` allows the page to send
    commands. Raises `TrustError` if the keys do not allow this, and `OSError` if the file exists or
    cannot be created.
    """
    from dwell.cellfile import load_without_traces
    from dwell.dash.metrics import CellMetrics
    from dwell.dash.observer import Observer
    from dwell.dash.server import Dash
    from dwell.dash.watched_cell import WatchedCell

    with ExitStack() as stack:
        observer = stack.enter_context(Observer(load_without_traces(file), environment))
        metrics = stack.enter_context(CellMetrics(observer))
        dash = Dash([WatchedCell(observer)], metrics=metrics.page)
        if control:
            _require_operator(observer)
            dash.act = _logged(observer)
        if mcap is not None:
            from dwell.dash.recorder import CellRecorder

            stack.enter_context(CellRecorder(observer, mcap, say))
        yield dash


def _require_operator(observer: Observer) -> None:
    """Refuse commands with the keys of an observer, or without keys for a cell on a network."""
    from dwell.live.host.security import exposed

    keyring = observer.security.keyring
    if keyring is None:
        if faults := list(exposed(observer.problem)):
            raise TrustError(
                f"--control without keys is for cells on this computer alone: {faults[0]}"
            )
    elif keyring.own.role == "observer":
        raise TrustError(f"{keyring.folder}: keys of an observer, who may look and no more")


def _logged(observer: Observer) -> Callable[[str, str], Mapping[str, Any]]:
    """Return a function that sends commands; it logs time, command, certificate and result."""

    def act(what: str, about: str) -> Mapping[str, Any]:
        keyring = observer.security.keyring
        who = "without keys" if keyring is None else f"by {keyring.own.common_name}"
        words = printable(f"{what} {about}".strip())[:200]
        said = f"{datetime.now().astimezone().isoformat(timespec='milliseconds')} {words} {who}"
        try:
            status = observer.act(what, about)
        except DwellError as error:
            say(f"{said}: {error}")
            raise
        say(f"{said}: done")
        return status

    return act
