"""Many faults of real processes, phases stratified over the period: what they cost.

``python -m tests.live.faults --out FILE`` goes on where it was stopped; every line of the file is
an outcome. ``--table`` prints what the file has.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from dwell.errors import DwellError
from dwell_lab.chaos.light_cell import EXEC_MS, PERIOD_MS
from dwell_lab.chaos.stalls import StallDetector
from dwell_lab.chaos.strike import Outcome
from tests.live.real_cell import FAULTS, HomeFault, RealCell, mixed, strike

#: Faults that one cell goes through before another is started.
A_CELL = 60
#: Periods that what is frozen or cut stays so: shorter and longer than a session's lease.
LASTS = 12, 60
Z = 1.96


def phases(fault: HomeFault, count: int, seed: int) -> list[float]:
    """One phase in each `count`-th of the period, in random order."""
    drawn = random.Random(f"{seed} {fault.name}")
    found = [(stratum + drawn.random()) / count for stratum in range(count)]
    drawn.shuffle(found)
    return found


def read(path: Path) -> list[Outcome]:
    """Return the outcomes of a file; a line that was being written is left out."""
    found = []
    with suppress(FileNotFoundError):
        for line in path.read_text().splitlines():
            with suppress(ValueError):
                found.append(Outcome(**json.loads(line)))
    return found


def campaign(path: Path, count: int, seed: int, names: Sequence[str], until_s: float) -> None:
    """Bring about what is missing until there are `count` of each fault, or the time is over."""
    done: dict[str, int] = dict.fromkeys(FAULTS, 0)
    for outcome in read(path):
        done[outcome.fault] += 1
    planned = {name: phases(fault, count, seed) for name, fault in FAULTS.items()}
    with StallDetector() as stalls:
        while time.monotonic() < until_s:
            rounds = {
                home: min((done[f.name] for f in mixed(home) if f.name in names), default=count)
                for home in EXEC_MS
            }
            home = min(EXEC_MS, key=rounds.__getitem__)
            if rounds[home] >= count:
                return
            with tempfile.TemporaryDirectory(prefix="dwell-faults-") as folder:
                _one_cell(
                    home, Path(folder), path, names, done, planned, stalls, count, seed, until_s
                )


def _one_cell(
    home: str,
    folder: Path,
    path: Path,
    names: Sequence[str],
    done: dict[str, int],
    planned: dict[str, list[float]],
    stalls: StallDetector,
    count: int,
    seed: int,
    until_s: float,
) -> None:
    with RealCell(home, folder / "cell", seed=seed) as cell:
        for _ in range(A_CELL):
            mine = [f for f in mixed(home) if f.name in names and done[f.name] < count]
            if not mine or time.monotonic() > until_s:
                break
            fault = min(mine, key=lambda one: done[one.name])
            phase = planned[fault.name][done[fault.name]]
            done[fault.name] += 1
            lasts = random.Random(f"{seed} {fault.name} {phase}").randint(*LASTS)
            stalls.stalls.clear()
            broken = False
            try:
                outcome = strike(cell, fault, stalls, phase=phase, seed=seed, lasts=lasts)
                outcome.wrong += cell.check_run()
            except DwellError as error:
                outcome = Outcome(fault.name, seed, phase, wrong=[str(error)])
                outcome.stall_ms = stalls.worst_ms(0, 1 << 62)
                broken = True
            with path.open("a") as file:
                file.write(json.dumps(asdict(outcome)) + "\n")
            print(_line(outcome), file=sys.stderr, flush=True)
            if outcome.wrong or broken:
                return
        cell.testbed.processes.stop_controller()
        wrong = cell.check_run()
        if wrong:
            print(f"run of {home}: {'; '.join(wrong)}", file=sys.stderr, flush=True)


def _line(outcome: Outcome) -> str:
    return (
        f"{outcome.fault:36} {outcome.phase:4.2f} {outcome.lost:3d} {outcome.lost_after:3d} "
        f"{outcome.gap_ms:6.0f} {outcome.gap_after_ms:6.0f} {outcome.recovery_ms:6.0f} ms  "
        f"stall {outcome.stall_ms:3.0f}  {outcome.moved}  {'; '.join(outcome.wrong)}"
    )


# ---------------------------------------------------------------------------------- table


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927); without a hit the exact bound, 3 / n for many."""
    if hits == 0:
        return 0.0, 1 - 0.05 ** (1 / count)
    share, square = hits / count, Z**2
    centre = (share + square / (2 * count)) / (1 + square / count)
    half = Z / (1 + square / count) * (share * (1 - share) / count + square / (4 * count**2)) ** 0.5
    return max(centre - half, 0.0), min(centre + half, 1.0)


def table(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Return the table of `reproduction/evidence/faults.md`."""
    yield (
        "| fault | n | cycles lost, median (most) | without actuation, ms, median (most) | "
        "at home again, s, median (most) | beyond the bound |"
    )
    yield "|---|---|---|---|---|---|"
    for fault in FAULTS.values():
        mine = [o for o in outcomes if o.fault == fault.name and o.moved]
        if not mine:
            continue
        lost = [max(o.lost, o.lost_after) for o in mine]
        gaps = [max(o.gap_ms, o.gap_after_ms) for o in mine]
        back = [o.recovery_ms / 1e3 for o in mine]
        over = sum(fault.bound is not None and most > fault.bound for most in lost)
        share = "no bound"
        if fault.bound is not None:
            low, high = wilson(over, len(mine))
            share = f"{over} ({100 * low:.0f} to {100 * high:.0f} %)"
        numbers = "-" if "stamper" in fault.name else f"{statistics.median(lost):.0f} ({max(lost)})"
        yield (
            f"| {fault.name} | {len(mine)} | {numbers} | "
            f"{statistics.median(gaps):.0f} ({max(gaps):.0f}) | "
            f"{statistics.median(back):.1f} ({max(back):.1f}) | {share} |"
        )
    bounded = [o for o in outcomes if o.moved and FAULTS[o.fault].bound is not None]
    over = sum(max(o.lost, o.lost_after) > (FAULTS[o.fault].bound or 0) for o in bounded)
    stalled = sum(o.stall_ms >= PERIOD_MS for o in bounded)
    failed = [o for o in outcomes if not o.moved]
    if bounded:
        low, high = wilson(over, len(bounded))
        yield ""
        yield (
            f"{len(bounded)} faults with a bound: {over} beyond it ({100 * low:.1f} to "
            f"{100 * high:.1f} %); in {stalled} the machine stalled for a period or more; "
            f"{len(failed)} in which an awaited event did not come."
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("faults.jsonl"))
    parser.add_argument("--each", type=int, default=60, help="of each fault")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="faults with this in their name")
    parser.add_argument("--minutes", type=float, default=1e6, help="then stop; to be gone on with")
    parser.add_argument("--nice", type=int, default=0, help="niceness of everything, as -10")
    parser.add_argument("--table", action="store_true", help="print what there is, and run nothing")
    asked = parser.parse_args(arguments)
    if not asked.table:
        # Whoever ends this ends the cell, too.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
        if asked.nice:
            os.setpriority(os.PRIO_PROCESS, 0, asked.nice)
            with suppress(OSError):
                Path("/proc/self/autogroup").write_text(str(asked.nice))
        names = [name for name in FAULTS if asked.only in name]
        until_s = time.monotonic() + 60 * asked.minutes
        campaign(asked.out, asked.each, asked.seed, names, until_s)
    outcomes = read(asked.out)
    print("\n".join(table(outcomes)))
    return int(any(outcome.wrong for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
