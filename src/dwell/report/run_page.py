"""The report of a single run: what happened, when, and why it was decided so."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dwell.record import OUTCOME_SENTENCES, REASON_SENTENCES
from dwell.report import live_facts, run_figures
from dwell.report.drawing import draw
from dwell.report.formatting import OURS, listed, percent, shown_scenario, write_number
from dwell.report.page import (
    Cell,
    definitions,
    document,
    figure,
    items,
    marked,
    paragraph,
    section,
    swatch,
    table,
)
from dwell.report.palette import Palette
from dwell.report.phase_rows import PhaseRow, phase_rows
from dwell.report.phases import Disturbed
from dwell.report.run_header import RunHeader
from dwell.report.style import PageStyle
from dwell.report.svg import inline
from dwell.report.timeline import run_timeline
from dwell.study import AIM
from dwell.study.summary import Counted, count_in, latency_ms, longest_streak, order_statistic

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

__all__ = ["run_html"]

MOST_ROWS = 40
WORST = 10
# Shares of a node's cores below this are not told.
LEAST_SHOWN = 5e-4


def run_html(run: Run) -> str:
    """Return a self-contained page about a run.

    Parameters
    ----------
    run : Run
        Simulated or live, just made or opened from its folder.

    Returns
    -------
    str
        HTML without scripts, and without anything that is loaded from elsewhere.

    Raises
    ------
    RunError
        If the run's record is incomplete.
    SimulationError
        If the run has no window after its warm-up.
    """
    facts = RunHeader.of(run)
    counted = count_in(run, facts.window_cycles)
    palette = Palette.of(facts.candidates)
    title = f"A run of {_policy(facts, counted)} on {facts.cell}"
    return document(title, _body(run, facts, counted, palette, title))


def _body(
    run: Run, facts: RunHeader, counted: Counted, palette: Palette, title: str
) -> Iterator[str]:
    seconds = counted.cycles.height * facts.period_ms / 1e3
    yield f"<h1>{escape(title)}</h1>"
    yield paragraph(
        f"{_what(facts)}: "
        f"{counted.windows.height} windows of {facts.window_cycles} cycles after the warm-up, "
        f"{write_number(seconds / 60)} minutes",
        "subtitle",
    )
    yield paragraph(
        "Did the cell meet its deadline, and what did the policy do for it?", "question"
    )
    yield items(_verdict(facts, counted))
    begins = _begins(run, facts)
    yield section("Through time", *_in_time(run, facts, palette, begins))
    yield section("Latency", *_latency(facts, counted, palette))
    yield section("Decisions", *_decisions(run, counted, facts, palette, begins))
    yield section(
        "Worst windows", _worst_windows(facts, counted, palette, _by_window(run.windows, begins))
    )
    if facts.live:
        yield section("How well this is known", items(live_facts.known(run, facts)))
    yield section("What this is", *_about(facts))


def _what(facts: RunHeader) -> str:
    if not facts.live:
        return f"Scenario “{shown_scenario(facts.scenario)}”, {facts.kind}, seed {facts.seed}"
    # A cell in earnest has no scenario but what happens to it.
    played = facts.scenario not in ("live", "–")
    return f"Live{f', scenario “{shown_scenario(facts.scenario)}”' if played else ''}"


def _begins(run: Run, facts: RunHeader) -> NDArray[np.float64]:
    """When every window began, seconds; a live run's cycles do not come by their numbers."""
    first = run.windows["first_cycle"].to_numpy()
    if not facts.live:
        nominal: NDArray[np.float64] = first * (facts.period_ms / 1e3)
        return nominal
    released = dict(zip(run.cycles["cycle"], run.cycles["release_ns"], strict=True))
    return np.array([released[cycle] / 1e9 for cycle in first.tolist()], np.float64)


def _policy(facts: RunHeader, counted: Counted) -> str:
    """Return the policy's name; a placement's where it never moves."""
    if facts.policy_name == "Static":
        return f"{counted.windows['placement'][0]}, which never moves,"
    return facts.policy_name


# ----------------------------------------------------------------------------------- verdict


def _verdict(facts: RunHeader, counted: Counted) -> Iterator[str]:
    cycles, windows, decisions = counted.cycles, counted.windows, counted.decisions
    missed = cycles["missed"].to_numpy()
    rate = float(missed.mean())
    place = "under" if rate < AIM else "above"
    final_ms = latency_ms(cycles)
    yield (
        f"{percent(rate, 1)} of {write_number(cycles.height, 0)} cycles missed the deadline of "
        f"{write_number(facts.deadline_ms)} ms, which is {place} the aim of {percent(AIM)}. The "
        f"95th percentile of their latencies is {write_number(order_statistic(final_ms, 95))} ms; "
        f"at worst {longest_streak(missed)} cycles in a row missed."
    )
    yield _lost(cycles)
    shares = windows["placement"].cast(str).value_counts(sort=True)
    where = listed(f"{percent(count / windows.height)} on {name}" for name, count in shares.rows())
    moved_at_all = decisions.filter(decisions["migrated"])
    by_guard = moved_at_all["reason"].cast(str) == "guard"
    moves, guards = moved_at_all.filter(~by_guard), moved_at_all.filter(by_guard)
    moved = f"with {_count(moves.height, 'migration')}" if len(moves) else "and never migrated"
    text = f"Of its windows it spent {where}, {moved}"
    undone = _undone(moves)
    text += f", {undone} of which undid the one before" if undone else ""
    yield f"{text}."
    if len(guards):
        yield (
            f"Beside these, the robot's guard moved it {_count(guards.height, 'time')}: nothing "
            "had come through for longer than it waits."
        )
    yield from _shadows(facts, counted.windows)
    yield (
        "One run is one sample: it says what happened, not what to expect. For intervals, compare "
        "runs over seeds."
    )


def _shadows(facts: RunHeader, windows: pl.DataFrame) -> Iterator[str]:
    """Say what shadow jobs cost, where there were any."""
    if "shadow_cycles" not in windows.columns or not windows["shadow_cycles"].sum():
        return
    cycles = windows.height * facts.window_cycles
    share = float(windows["shadow_cycles"].sum()) / cycles
    rate_mbps = float(windows["shadow_bytes"].sum()) * 8e-3 / (cycles * facts.period_ms)
    used = {node: windows[f"shadow_{node}"].mean() for node in facts.nodes}
    taken = listed(
        f"{percent(mean, 1)} of {node}"
        for node, mean in used.items()
        if isinstance(mean, float) and mean >= LEAST_SHOWN
    )
    yield (
        f"{percent(share, 1)} of the cycles went through another placement as well, for the "
        f"estimator: these shadow jobs took {taken or 'next to no compute time'}, and sent "
        f"{write_number(rate_mbps, 2)} Mbit/s more over the links."
    )


def _lost(cycles: pl.DataFrame) -> str:
    outcomes = dict(cycles["outcome"].cast(str).value_counts().rows())
    found = [
        f"{_count(outcomes[name], 'cycle')} because {why}"
        if name != "in_flight"
        else f"{_count(outcomes[name], 'cycle')} {why}"
        for name, why in OUTCOME_SENTENCES.items()
        if name != "done" and outcomes.get(name)
    ]
    if not found:
        return "Every cycle finished."
    return f"Not finished: {listed(found)}."


def _undone(moves: pl.DataFrame) -> int:
    pairs = moves.select("incumbent", "placement").rows()
    return sum(now == before[::-1] for before, now in itertools.pairwise(pairs))


def _count(number: int, what: str) -> str:
    return f"{write_number(number, 0)} {what}{'' if number == 1 else 's'}"


# ----------------------------------------------------------------------------------- figures


def _in_time(
    run: Run, facts: RunHeader, palette: Palette, begin_s: NDArray[np.float64]
) -> Iterator[str]:
    shown = run_timeline(
        run.windows,
        run.decisions,
        candidates=tuple(facts.candidates),
        period_ms=facts.period_ms,
        deadline_ms=facts.deadline_ms,
        slug="time",
        begin_s=begin_s,
        disturbed=facts.disturbed,
        tracking=facts.tracking,
    )
    error = " The tracking error is its root mean square." if facts.tracking is not None else ""
    yield figure(
        inline(draw(shown, PageStyle(palette, frozenset())), shown.slug, shown.title),
        "Each mark is a window and has the colour of the placement that was active. In the panel "
        "of J the lines without marks are what the other placements were estimated to cost."
        + error,
    )
    rows = phase_rows(run, facts)
    if len(rows) > 1:
        yield _by_phase(facts, palette, rows)
    yield figure(
        run_figures.node_use_in_time(run.windows, facts.nodes, begin_s),
        "Utilisation of each node as its operating system shows it: foreign work included.",
    )


def _by_phase(facts: RunHeader, palette: Palette, phases: Sequence[PhaseRow]) -> str:
    """Say what every phase showed."""
    guarded = any(row.guard_moves for row in phases)
    tracked = facts.tracking is not None
    rows: list[tuple[str, Sequence[Cell]]] = []
    for row in phases:
        placed = "<br>".join(
            f'<span class="nowrap">{_placed(palette, name)} {percent(share)}</span>'
            for name, share in row.shares.items()
        )
        cells = [
            Cell(escape(row.name)),
            Cell(f"{row.begin_s:.0f} to {row.end_s:.0f}", "num"),
            Cell(placed),
            Cell(write_number(100 * row.violation_rate), "num"),
            Cell(write_number(row.l95_ms), "num"),
            Cell(str(row.lost), "num"),
            Cell(str(row.migrations), "num"),
        ]
        cells += [Cell(str(row.guard_moves), "num")] if guarded else []
        if tracked:
            cells += [
                Cell(write_number(row.rms_mm, 2), "num"),
                Cell(write_number(row.rms_px), "num"),
            ]
        rows.append(("", cells))
    head = [
        Cell("phase"),
        Cell("time (s)", "num"),
        Cell("placed"),
        Cell(marked("V_D (%)"), "num"),
        Cell("L95 (ms)", "num"),
        Cell("lost", "num"),
        Cell("migrations", "num"),
    ]
    head += [Cell("by the guard", "num")] if guarded else []
    head += [Cell("error (mm)", "num"), Cell("error (px)", "num")] if tracked else []
    done = listed(f"{one.kind} ({one.what})" for one in _once(facts))
    caption = (
        f"All cycles by when they were released, the warm-up included. Played: {done}. Lost: "
        "cycles that never finished."
    )
    if tracked:
        caption += (
            " Error: root mean square, over time, of how far the hand is from where it ought to "
            "be, and the tag from the middle of the picture."
        )
    return table(head, rows, caption)


def _once(facts: RunHeader) -> list[Disturbed]:
    """Return what was done, each thing once."""
    return list({(one.kind, one.what): one for one in facts.disturbed}.values())


def _latency(facts: RunHeader, counted: Counted, palette: Palette) -> Iterator[str]:
    yield figure(
        run_figures.latencies_by_placement(
            counted.cycles, PageStyle(palette, frozenset()), facts.deadline_ms
        ),
        "Latency of the cycles that were released under each placement: one less the empirical "
        "distribution function, on a logarithmic scale. Dotted: 5 %.",
    )
    yield figure(
        run_figures.split_by_placement(counted.cycles, palette.placements, facts.deadline_ms),
        "Where the time goes along the critical path of the cycles that finished.",
    )


# ------------------------------------------------------------------------------------ tables


def _decisions(
    run: Run, counted: Counted, facts: RunHeader, palette: Palette, begins: NDArray[np.float64]
) -> Iterator[str]:
    decisions = counted.decisions
    counts = dict(decisions["reason"].cast(str).value_counts().rows())
    yield items(
        f"`{name}`, {_count(counts[name], 'time')}: {text}"
        for name, text in REASON_SENTENCES.items()
        if counts.get(name)
    )
    moves = decisions.filter(decisions["migrated"])
    if not moves.is_empty():
        yield _migrations(run, facts, palette, moves, begins)


def _migrations(
    run: Run, facts: RunHeader, palette: Palette, moves: pl.DataFrame, begins: NDArray[np.float64]
) -> str:
    cost = dict(run.windows.select("window", "cost").rows())
    begin_s = _by_window(run.windows, begins)
    rows: list[tuple[str, Sequence[Cell]]] = []
    for move in moves.head(MOST_ROWS).iter_rows(named=True):
        window, target = move["window"], move["placement"]
        by_guard = move["reason"] == "guard"
        # A move of the guard is noted under the window that follows it.
        before, after = (window - 1, window) if by_guard else (window, window + 1)
        if by_guard or before not in begin_s:
            at_s = begin_s.get(window, math.nan)
        else:
            at_s = begin_s[before] + facts.window_cycles * facts.period_ms / 1e3
        numbers = (cost.get(before), move[f"j_{target}"], cost.get(after))
        cells = [
            Cell(str(before)),
            Cell(write_number(at_s), "num"),
            Cell(f"{_placed(palette, move['incumbent'])} → {_placed(palette, target)}"),
            Cell("by the guard" if by_guard else escape(str(move["reason"]))),
            *(Cell(write_number(_number(value), 2), "num") for value in numbers),
        ]
        rows.append(("", cells))
    head = [
        Cell("after window"),
        Cell("at (s)", "num"),
        Cell("migration"),
        Cell("reason"),
        Cell("J before", "num"),
        Cell("J estimated", "num"),
        Cell("J after", "num"),
    ]
    more = moves.height - MOST_ROWS
    caption = (
        "Every move: measured J of the window before it, J that was estimated for the "
        "target, and measured J of the first window on it."
    )
    return table(head, rows, f"{caption} {more} more are left out." if more > 0 else caption)


def _by_window(windows: pl.DataFrame, begins: NDArray[np.float64]) -> Mapping[int, float]:
    return dict(zip(windows["window"].to_list(), begins.tolist(), strict=True))


def _worst_windows(
    facts: RunHeader, counted: Counted, palette: Palette, all_begins: Mapping[int, float]
) -> str:
    worst = counted.windows.sort(
        "violation_rate", "seen_l95_ms", descending=True, nulls_last=True, maintain_order=True
    ).head(WORST)
    rows: list[tuple[str, Sequence[Cell]]] = []
    for window in worst.iter_rows(named=True):
        begin_s = all_begins[window["window"]]
        used = [_number(window[f"u_{node}"]) for node in facts.nodes]
        cells = [
            Cell(str(window["window"])),
            Cell(f"{begin_s:.1f}", "num"),
            Cell(_placed(palette, window["placement"])),
            Cell(write_number(100 * window["violation_rate"]), "num"),
            Cell(write_number(_number(window["l95_ms"])), "num"),
            Cell(write_number(_number(window["cost"]), 2), "num"),
            *(Cell(write_number(100 * value, 0), "num") for value in used),
        ]
        rows.append(("", cells))
    head = [
        Cell("window"),
        Cell("at (s)", "num"),
        Cell("placement"),
        Cell(marked("V_D (%)"), "num"),
        Cell("L95 (ms)", "num"),
        Cell("J", "num"),
        *(Cell(f"{escape(node)} (%)", "num") for node in facts.nodes),
    ]
    return table(
        head,
        rows,
        f"The {len(rows)} windows with the most misses. L95 of final latencies: ∞ where more than "
        "5 % of the cycles never finished. The last columns are the utilisation of the nodes.",
    )


def _about(facts: RunHeader) -> Iterator[str]:
    yield definitions(
        {
            "cell": facts.cell,
            "scenario": facts.scenario,
            "record": f"{facts.kind}, seed {facts.seed}",
            "policy": facts.policy,
            "estimator": facts.estimator,
            "window": f"{facts.window_cycles} cycles of {write_number(facts.period_ms)} ms, "
            f"deadline {write_number(facts.deadline_ms)} ms",
            "placements": _placements(facts),
            "versions": ", ".join(f"{name} {text}" for name, text in facts.versions.items()),
        }
    )
    if facts.policy_name in ("ATP", "ATPThresholds"):
        yield paragraph(OURS)


def _placements(facts: RunHeader) -> str:
    """Say where each candidate puts the tasks that are not on the same node in all of them."""
    first = next(iter(facts.candidates.values()))
    parts = []
    for name, placed in facts.candidates.items():
        moving = [
            f"{task} on {node}"
            for task, node in placed.items()
            if any(other.get(task) != first.get(task) for other in facts.candidates.values())
        ]
        parts.append(f"{name}: {listed(moving)}" if moving else name)
    return "; ".join(parts)


def _placed(palette: Palette, name: str) -> str:
    return f'<span class="nowrap">{swatch(palette.placements[name])}{escape(name)}</span>'


def _number(value: float | None) -> float:
    return math.nan if value is None else value
