"""Tests use what a user or a neighbour module sees: their private names, each with its reason."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Most uses of private names in all tests.
MOST = 57
#: Public names that begin with an underscore: of named tuples, notebooks and `os`.
PUBLIC = {"_asdict", "_exit", "_fields", "_make", "_replace", "_repr_html_"}
#: Functions that replace an attribute, whose name they get as a string.
REPLACES = {"around", "delattr", "setattr"}

BOUND = "the number of values in memory has no public name"
COST = "the number of calls or of kept results has no public name"
PLANTED = "plants a fault in a single step"
RACE = "makes a state that processes reach only by chance of timing"
SEEN = "compares an intermediate result with an independent one"

#: The private names that each file uses, with the reason of each. The table may only shrink.
USES: dict[str, dict[str, str]] = {
    "tests/control/test_guard.py": {"_silence": BOUND, "_spent_ns": SEEN},
    "tests/control/test_ledger_sets.py": {"_price": COST},
    "tests/estimators/test_candidate_player.py": {"_twins": SEEN},
    "tests/estimators/test_corrected.py": {"_pools": SEEN},
    "tests/estimators/test_waits.py": {"_take_in": SEEN},
    "tests/kernels/test_library.py": {"_handle": SEEN},
    "tests/live/host/test_hosting.py": {"_due_ns": RACE},
    "tests/live/host/test_key_renewal.py": {"_looked": RACE},
    "tests/live/roles/test_controlled_cell.py": {
        "_recorded": BOUND,
        "_send": RACE,
        "_move": RACE,
        "_next_number": RACE,
    },
    "tests/live/roles/test_latencies.py": {"_waiting": BOUND},
    "tests/live/roles/test_live_windows.py": {
        "_by_key": BOUND,
        "_windows": BOUND,
        "_in_flight": BOUND,
    },
    "tests/live/roles/test_offsets.py": {"_pairs": BOUND},
    "tests/live/roles/test_recording.py": {"_journal": RACE},
    "tests/live/small_world.py": {"_jobs": BOUND, "_joins": BOUND, "_move": RACE},
    "tests/live/test_fan_in.py": {"_source": SEEN, "_last": SEEN},
    "tests/live/test_faults.py": {"_partial": RACE},
    "tests/live/test_flood.py": {"_of": BOUND, "_read": BOUND},
    "tests/live/test_modes.py": {"_do": SEEN},
    "tests/live/test_seeded_faults.py": {
        "_gate": PLANTED,
        "_move": PLANTED,
        "_answer": PLANTED,
        "_refusal": PLANTED,
        "_send": PLANTED,
        "_begin_anew": PLANTED,
        "_uneven": PLANTED,
    },
    "tests/live/transport/test_zenoh.py": {"_routes": PLANTED},
    "tests/live/trust/test_signing.py": {
        "_charge": RACE,
        "_keys": PLANTED,
        "_verifies": COST,
        "_good": BOUND,
    },
    "tests/live/wire/test_messages.py": {
        "_by_key": BOUND,
        "_kept": BOUND,
        "_longest": BOUND,
        "_known": BOUND,
    },
}


def is_private(name: str) -> bool:
    """Whether a name is private, and no name of Python's own."""
    return re.fullmatch(r"_[a-zA-Z]\w*", name) is not None and name not in PUBLIC


def uses(tree: ast.AST) -> Iterator[str]:
    """Yield the private names of other objects and modules that a source uses."""
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(value=ast.Name(id="self" | "cls")):
                pass
            case ast.Attribute(attr=name) if is_private(name):
                yield name
            case ast.ImportFrom(names=names):
                yield from (alias.name for alias in names if is_private(alias.name))
            case ast.Call(func=function, args=given):
                if ast.unparse(function).rpartition(".")[2] in REPLACES:
                    texts = (one.value for one in given if isinstance(one, ast.Constant))
                    last = (one.rpartition(".")[2] for one in texts if isinstance(one, str))
                    yield from (name for name in last if is_private(name))


def test_private_names_are_counted_wherever_they_are_used() -> None:
    source = """
from module import _one, two
two._three, self._four, two._replace
patch.setattr(two, "_five", 1); patch.setattr("module._six", 1)
"""
    assert sorted(uses(ast.parse(source))) == ["_five", "_one", "_six", "_three"]


def test_tests_use_public_names() -> None:
    found: dict[str, Counter[str]] = {}
    for folder in ("tests", "lab/tests"):
        for path in (ROOT / folder).rglob("*.py"):
            names = Counter(uses(ast.parse(path.read_text(encoding="utf-8"))))
            found |= {str(path.relative_to(ROOT)): names} if names else {}
    assert {file: names.keys() for file, names in found.items()} == {
        file: names.keys() for file, names in USES.items()
    }
    assert sum(names.total() for names in found.values()) <= MOST
