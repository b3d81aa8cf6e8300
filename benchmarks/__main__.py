"""Run the benchmarks: `python -m benchmarks [NAME ...] [--quick] [--json]`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module

from benchmarks.figures import Section, as_json, print_sections
from benchmarks.machine import available_cores, describe, pin

# Name of each benchmark, and where it is; in the order in which they run.
BENCHMARKS = {
    "peers": ("chain", "measure"),
    "loop": ("loop", "measure"),
    "learning": ("loop", "learning"),
    "canonical": ("canonical", "measure"),
    "length": ("canonical", "length"),
    "replicated": ("replicated", "measure"),
    "closing": ("closing", "measure"),
    "deciding": ("deciding", "measure"),
    "pricing": ("pricing", "measure"),
    "regimes": ("regimes", "measure"),
    "sooner": ("sooner", "measure"),
    "passing": ("passing_faults", "measure"),
    "errors": ("stated_errors", "measure"),
    "rates": ("rated_prices", "measure"),
    "rate-times": ("rated_times", "measure"),
    "placements": ("placements", "measure"),
    "schedulers": ("placements", "schedulers"),
    "all": ("all_candidates", "measure"),
    "clairvoyant": ("clairvoyant", "measure"),
    "fleet": ("fleet", "measure"),
    "ledger": ("fleet_ledger", "measure"),
    "capacity": ("capacity_sizes", "measure"),
    "optimum": ("fleet_optimum", "measure"),
    "study": ("study", "measure"),
    "parts": ("parts", "measure"),
    "memory": ("memory", "measure"),
    "draw": ("drawing", "measure"),
    "start": ("starting", "measure"),
    "size": ("size", "measure"),
    "import": ("importing", "measure"),
    "page": ("page", "measure"),
    "link": ("link", "measure"),
    "testbed-link": ("testbed_link", "measure"),
    "transport": ("transport", "measure"),
    "order": ("live", "decision"),
    "moves": ("live", "moves"),
    "share": ("live", "share"),
    "rest": ("at_rest", "measure"),
    "page-cost": ("page_cost", "measure"),
    "live-fleet": ("fleet_live", "measure"),
    "restart": ("restart", "measure"),
    "kills": ("rated_live", "measure"),
    "leaving": ("leaving", "measure"),
    "ros": ("ros_ends", "measure"),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what was asked for, on one core, and print it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="smaller and fewer runs")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    asked = parser.parse_args(arguments)
    unknown = [name for name in asked.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}")
    names = asked.names or list(BENCHMARKS)
    cores = available_cores()
    machine = describe(cores)
    pin(cores)
    begin = time.perf_counter()
    sections = _measure(names, asked.quick)
    if asked.json:
        found = [as_json(name, section) for name, section in zip(names, sections, strict=True)]
        print(json.dumps({"machine": machine, "benchmarks": found}, indent=2, ensure_ascii=False))
        return
    print("\n".join(f"{key:9}  {value}" for key, value in machine.items()), end="\n\n")
    print_sections(sections)
    print(f"{time.perf_counter() - begin:.0f} s in all")


def _measure(names: Sequence[str], quick: bool) -> Iterator[Section]:
    for name in names:
        print(f"{name} ...", file=sys.stderr, flush=True)
        module, function = BENCHMARKS[name]
        # Imported after the pinning, so that no library counts cores that it does not get.
        measure: Callable[[bool], Section] = getattr(
            import_module(f"benchmarks.{module}"), function
        )
        yield measure(quick)


if __name__ == "__main__":
    main()
