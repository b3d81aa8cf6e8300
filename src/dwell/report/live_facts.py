"""What is to be said of a live run only: clocks, what was not heard, and what was recovered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from dwell.report.formatting import listed, percent, write_number

if TYPE_CHECKING:
    from dwell.record import Run
    from dwell.report.run_header import RunHeader

__all__ = ["known", "recovery"]


def known(run: Run, facts: RunHeader) -> Iterator[str]:
    """Yield sentences on how well a live run is known."""
    yield _clocks(run, facts)
    yield from _unheard(run)
    yield from _lead(run)
    yield from recovery(facts.recovered)


def _clocks(run: Run, facts: RunHeader) -> str:
    windows = run.windows
    bounds = windows["bound_ms"].drop_nulls()
    unproven = int(windows["unproven"].sum())
    limit = "20 % of D"
    if not unproven:
        largest = write_number(float(str(bounds.max())), 2) if len(bounds) else "–"
        return (
            "Latencies are differences of clocks of several nodes: they are right to "
            f"±{largest} ms in every window, below {limit}."
        )
    share = percent(unproven / windows.height)
    whole = f"{unproven} of {windows.height} windows ({share})"
    return (
        f"{whole} are unproven: the clocks of the nodes agree there no better than {limit} "
        f"({write_number(0.2 * facts.deadline_ms)} ms), or were not compared. Their latencies may "
        "be off by more than that; the others' are not."
    )


def _unheard(run: Run) -> Iterator[str]:
    cycles = run.cycles
    silent = cycles.height - int(cycles["heard"].sum())
    if silent:
        yield (
            f"Of {write_number(silent, 0)} of {write_number(cycles.height, 0)} cycles nothing was "
            "heard: their neighbours' numbers say that they were released, and they count as lost."
        )
    away = int((cycles["outcome"].cast(str) == "done").sum()) - int(cycles["actuated"].sum())
    if away > 0:
        which = "1 command arrived and was" if away == 1 else f"{away} commands arrived and were"
        yield f"{which} not applied: too old, or behind a later one."


def _lead(run: Run) -> Iterator[str]:
    cycles = int(run.cycles["lead"].sum())
    if cycles:
        which = "1 cycle is" if cycles == 1 else f"{write_number(cycles, 0)} cycles are"
        yield (
            f"{which} in no window (lead cycles): a window holds cycles of one placement, and "
            "begins with the first one after a move."
        )


def recovery(told: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on what is not in a run because something was killed or damaged.

    Parameters
    ----------
    told : mapping
        What its meta say under ``recovered``.
    """
    opened = int(told.get("opened", 1))
    if opened > 1:
        yield f"The controller was started {opened} times while the run went on."
    lost = [
        text
        for name, text in (
            ("torn_bytes", "{} bytes at the journal's end were torn by a kill"),
            ("damaged_bytes", "{} bytes within the journal were damaged"),
        )
        if told.get(name)
        for text in [text.format(told[name])]
    ]
    if lost:
        yield f"{listed(lost)}; what they said is not here."
    if told.get("missing_windows"):
        yield f"Windows missing from the run: {told['missing_windows']}."
    if told and not told.get("sealed", True):
        yield (
            "The run was not closed: it goes on, or its controller was killed. This is what its "
            "journal holds; what came after its last window is not here."
        )
