"""Write reproduction/evidence/replicas.md: `python -m docs.replica_tables [--seeds N]`.

BOTH (LOC and SO, at once) and the policy `replicate` in the dynamic scenarios, against the
clairvoyant of placements without replicas on the same realisations. It takes half a minute per
scenario and seed. Intervals are 95 % intervals over seeds, differences are taken seed by seed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

import dwell
from dwell.model import Problem, Replicas
from dwell.record import Run
from dwell.study import load_study, mean_interval
from dwell.study.reference import few_misses, mean_cost, references, tier_use
from reproduction.evidence.measured_on import measured_on

ROOT = Path(__file__).parents[1]
STUDY = ROOT / "examples" / "studies" / "dynamic.yaml"
PAGE = ROOT / "reproduction" / "evidence" / "replicas.md"
SCENARIOS = ("step", "drift", "bursts", "flapping", "mixture")
WINDOWS, SEEDS = 300, 6
MEMBERS = ("LOC", "SO")
#: All pairs of placements; BOTH is the first.
PAIRS = {"BOTH": ("LOC", "SO"), "LOC-HYB": ("LOC", "HYB"), "HYB-SO": ("HYB", "SO")}


class Contender(NamedTuple):
    """What is compared with the clairvoyant: a policy and the replicas that its cell declares."""

    policy: str
    pairs: tuple[str, ...]


CONTENDERS = {
    "BOTH": Contender("BOTH", ("BOTH",)),
    "replicate": Contender("replicate", ("BOTH",)),
    "replicate, all pairs": Contender("replicate", tuple(PAIRS)),
    "dtp with BOTH": Contender("dtp", ("BOTH",)),
    "dtp": Contender("dtp", ()),
}
TERMS = ("latency", "violations", "robot", "edge", "switching")
#: Weight of the robot's CPU with which a second copy costs more than it saves.
DEAR = 5.0

Floats: TypeAlias = NDArray[np.float64]


class Played(NamedTuple):
    """Means of one run over the windows after the warm-up.

    Parameters
    ----------
    terms : float64 array, shape (5,)
        Terms of J, in the order of `TERMS`.
    missed : float
        V_D.
    doubled : float
        Share of the cycles with two copies.
    """

    cost: float
    terms: Floats
    missed: float
    doubled: float


@dataclass(frozen=True)
class Compared:
    """Runs of one scenario and seed.

    Parameters
    ----------
    runs : mapping of str to Played
        By placement, policy, or ``clairvoyant``.
    able, kept : int
        Windows with a V_D of at most 5 % under LOC or SO alone; those in which BOTH has it, too.
    dear : float
        Share of the cycles with two copies under `replicate`, with the weight `DEAR`.
    """

    runs: Mapping[str, Played]
    able: int
    kept: int
    dear: float


def cell() -> Problem:
    """Return the canonical cell with default settings of the controller, and without replicas."""
    problem = load_study(STUDY).points[0].problem
    controller = replace(
        problem.controller,
        policy="dtp",
        estimator="corrected",
        decide_cycles=None,
        min_dwell=None,
        shadow_fraction="auto",
    )
    return replace(problem, controller=controller)


def with_pairs(problem: Problem, names: Iterable[str]) -> Problem:
    """Add candidates that send each cycle through two placements at once."""
    known = problem.candidates
    pairs = {name: Replicas({one: known[one] for one in PAIRS[name]}) for name in names}
    return replace(problem, candidates={**known, **pairs})


def played(run: Run, problem: Problem) -> Played:
    """Return the means of a run."""
    windows = run.arrays("windows")
    counted = ~windows["warmup"] & np.isfinite(windows["cost"])
    weights, targets = problem.objective.weights, problem.objective.targets
    robot, edge, _ = tier_use(windows, problem)
    rows = [
        weights.latency * windows["seen_l95_ms"] / targets.latency_ms,
        weights.violations * windows["violation_rate"],
        weights.robot * robot / targets.robot,
        weights.edge * edge / targets.edge,
    ]
    known = np.array([row[counted].mean() for row in rows])
    cost = mean_cost(run)
    names = run.cycles["placement"].cast(str)[problem.warmup_windows * problem.window_cycles :]
    missed = float(windows["violation_rate"][counted].mean())
    terms = np.append(known, cost - known.sum())
    return Played(cost, terms, missed, float(names.is_in([*PAIRS]).to_numpy().mean()))


def compared(scenario: str, seed: int, windows: int = WINDOWS) -> Compared:
    """Simulate the placements, the clairvoyant and the contenders of one scenario and seed."""
    single = cell()
    drawn = dwell.draw(single, scenario=scenario, seed=seed, windows=windows)
    reference = references(single, drawn)
    runs = {name: played(run, single) for name, run in reference.statics.items()}
    runs["clairvoyant"] = played(reference.run, single)

    def simulate(problem: Problem, policy: str) -> Run:
        return dwell.simulate(problem, scenario=scenario, policy=policy, seed=seed, windows=windows)

    for name, (policy, pairs) in CONTENDERS.items():
        problem = with_pairs(single, pairs)
        run = simulate(problem, policy)
        runs[name] = played(run, problem)
        if name == "BOTH":
            few = few_misses(run, problem)
    able = np.logical_or(*(few_misses(reference.statics[name], single) for name in MEMBERS))
    double = with_pairs(single, ("BOTH",))
    weights = replace(double.objective.weights, robot=DEAR)
    dear = replace(double, objective=replace(double.objective, weights=weights))
    doubled = played(simulate(dear, "replicate"), dear).doubled
    return Compared(runs, int(able.sum()), int((able & few).sum()), doubled)


def interval(values: Iterable[float], decimals: int = 3) -> str:
    """Write a mean with its interval."""
    mean, low, high = mean_interval(np.array([*values]))
    half = max(mean - low, high - mean)
    return f"{mean:+.{decimals}f} ± {half:.{decimals}f}".replace("-", "−")


def costs(found: Mapping[str, list[Compared]]) -> Iterator[str]:
    """Yield the table of J."""
    yield f"| scenario | clairvoyant | best of LOC, SO, HYB | {' | '.join(CONTENDERS)} |"
    yield "|---" * (3 + len(CONTENDERS)) + "|"
    for scenario, seeds in found.items():
        best = min(np.mean([one.runs[name].cost for one in seeds]) for name in cell().candidates)
        cells = [f"{np.mean([one.runs['clairvoyant'].cost for one in seeds]):.3f}", f"{best:.3f}"]
        for name in CONTENDERS:
            mean = np.mean([one.runs[name].cost for one in seeds])
            less = (one.runs[name].cost - one.runs["clairvoyant"].cost for one in seeds)
            cells.append(f"{mean:.3f} ({interval(less)})")
        yield f"| `{scenario}` | {' | '.join(cells)} |"


def decomposed(found: Mapping[str, list[Compared]], name: str) -> Iterator[str]:
    """Yield the table of the terms of J above the clairvoyant's."""
    yield f"| scenario | J | {' | '.join(TERMS)} |"
    yield "|---" * (2 + len(TERMS)) + "|"
    for scenario, seeds in found.items():
        more = np.array([one.runs[name].terms - one.runs["clairvoyant"].terms for one in seeds])
        cells = [interval(more.sum(axis=1)), *(interval(more[:, i]) for i in range(len(TERMS)))]
        yield f"| `{scenario}` | {' | '.join(cells)} |"


def misses(found: Mapping[str, list[Compared]]) -> Iterator[str]:
    """Yield the table of V_D, and of the windows in which LOC or SO alone has few misses."""
    names = (*MEMBERS, "HYB", "clairvoyant", *CONTENDERS)
    yield f"| scenario | {' | '.join(names)} | windows with V_D ≤ 5 % under LOC or SO | with BOTH |"
    yield "|---" * (3 + len(names)) + "|"
    for scenario, seeds in found.items():
        rates = [100 * np.mean([one.runs[name].missed for one in seeds]) for name in names]
        able, kept = sum(one.able for one in seeds), sum(one.kept for one in seeds)
        cells = [*(f"{rate:.1f} %" for rate in rates), str(able), f"{100 * kept / able:.1f} %"]
        yield f"| `{scenario}` | {' | '.join(cells)} |"


def doubled(found: Mapping[str, list[Compared]]) -> Iterator[str]:
    """Yield the table of the share of the cycles with two copies under `replicate`."""
    heading = f"with a weight of the robot's CPU of {DEAR:g}"
    yield f"| scenario | cycles with two copies, all pairs | BOTH alone | BOTH alone, {heading} |"
    yield "|---|---|---|---|"
    for scenario, seeds in found.items():
        names = "replicate, all pairs", "replicate"
        rates = [np.mean([one.runs[name].doubled for one in seeds]) for name in names]
        rates.append(np.mean([one.dear for one in seeds]))
        yield f"| `{scenario}` | {' | '.join(f'{100 * rate:.1f} %' for rate in rates)} |"


def tables(found: Mapping[str, list[Compared]]) -> Iterator[str]:
    """Yield the lines of all tables, after their headings."""
    yield "\n## J\n"
    yield from costs(found)
    for name in ("BOTH", "replicate", "dtp with BOTH"):
        yield f"\n## Terms of J above the clairvoyant's: {name}\n"
        yield from decomposed(found, name)
    yield "\n## Misses\n"
    yield from misses(found)
    yield "\n## How often `replicate` sends two copies\n"
    yield from doubled(found)


HEAD = """# Replicas in the dynamic scenarios

{measured}

`python -m docs.replica_tables` writes these tables. The cell is `examples/canonical.yaml` with the
default settings of the controller and a candidate `BOTH: {{replicas: [LOC, SO]}}`, in the scenarios
of `examples/studies/dynamic.yaml`: {seeds} seeds of {windows} windows, the warm-up left out. The
clairvoyant knows every future window of LOC, SO and HYB alone and moves between them; it is the
cheapest such sequence. `replicate` has the base `dtp`, and the candidate BOTH, or all three pairs
of placements. ± is the half-width of a 95 % interval over seeds, and differences are taken seed by
seed.
"""


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    seeds = parser.parse_args().seeds
    found: dict[str, list[Compared]] = {}
    for scenario in SCENARIOS:
        found[scenario] = []
        for seed in range(1, seeds + 1):
            print(f"{scenario}, seed {seed} ...", file=sys.stderr, flush=True)
            found[scenario].append(compared(scenario, seed))
    measured = f"Last m{measured_on()[1:]}"
    head = HEAD.format(measured=measured, seeds=seeds, windows=WINDOWS)
    PAGE.write_text(head + "\n".join(tables(found)) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
