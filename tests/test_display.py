"""Every public object says in a few lines what it is, and has a picture where it is a result."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.control import (
    CellGuard,
    ClosedWindow,
    Controller,
    Failures,
    FallbackRound,
    Guard,
    LookedAt,
    Presence,
    Probation,
)
from dwell.display import Displayed, milliseconds
from dwell.estimators import Evidence, Instants
from dwell.estimators import by_name as estimator_by_name
from dwell.model import (
    FrozenDict,
    Problem,
    QoS,
    Trace,
    TraceTable,
)
from dwell.model.fleet import Fleet, FleetEntry
from dwell.model.shadow_plan import ShadowPlan
from dwell.policies import by_name as policy_by_name
from dwell.policies.registry import REGISTRY as POLICIES
from dwell.record import Journal
from dwell.study import (
    Hindsight,
    Limiting,
    Shard,
    StudyResult,
    capacity_of,
    compare,
    load_study,
    mean_interval,
    open_study,
    run_study,
)
from dwell_lab.validation.validation import validate

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
PACKAGES = ("", ".model", ".policies", ".estimators", ".study", ".record", ".sim", ".control")
#: Lines of a representation, and characters of a line.
LINES, CHARACTERS = 19, 700
SCREEN_LINES, SCREEN_COLUMNS = 24, 80
#: Not made here: tuples of a few numbers and names.
FEW_NUMBERS = {
    *(
        "Chain",
        "Endpoint",
        "Episodes",
        "Family",
        "MissCap",
        "Replicas",
        "Move",
        "PairedDifference",
        "PairedMedian",
    ),
    *("Phase", "QoS", "Support"),
}


def public_classes() -> set[type]:
    """Return what can be made of what packages say is public; no protocols, no errors."""
    found: set[type] = set()
    for package in PACKAGES:
        module = import_module(f"dwell{package}")
        for name in module.__all__:
            thing = getattr(module, name)
            made = inspect.isclass(thing) and not getattr(thing, "_is_protocol", False)
            if made and not issubclass(thing, BaseException):
                found.add(thing)
    return found


def walk(thing: object, seen: dict[type, object]) -> None:
    """Take note of an object of every class in a thing: the one that says most."""
    kind = type(thing)
    before = seen.get(kind)
    if before is None or len(repr(thing)) > len(repr(before)):
        seen[kind] = thing
    parts: Iterator[object] = iter(())
    if is_dataclass(thing):
        parts = (getattr(thing, item.name) for item in fields(thing))
    elif isinstance(thing, Mapping):
        parts = iter(thing.values())
    elif isinstance(thing, Sequence) and not isinstance(thing, str | bytes):
        parts = iter(thing)
    for part in parts:
        if not isinstance(part, str | bytes | int | float | pl.DataFrame | np.ndarray | None):
            walk(part, seen)


@pytest.fixture(scope="module")
def canonical() -> Problem:
    return dwell.load(EXAMPLES / "canonical.yaml")


@pytest.fixture(scope="module")
def run(canonical: Problem) -> dwell.Run:
    return dwell.simulate(canonical, seed=1, windows=30, scenario="robot-cpu-stress", jobs=True)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    declared = replace(load_study(EXAMPLES / "studies" / "tenants.yaml"), seeds=(1, 2), windows=10)
    return run_study(declared, folder=tmp_path_factory.mktemp("study"), processes=1)


@pytest.fixture(scope="module")
def shown(canonical: Problem, run: dwell.Run, study: StudyResult) -> dict[str, Displayed]:
    """What has a summary, and a picture."""
    comparison = compare(
        canonical, policies=["LOC", "SO", "dtp"], seeds=[1, 2], windows=10, processes=1
    )
    return {
        "problem": canonical,
        "run": run,
        "comparison": comparison,
        "study": study,
        "saved study": open_study(str(study.folder)),
        "validation": validate({"one": run}, canonical, seeds=2),
    }


@pytest.fixture(scope="module")
def objects(
    canonical: Problem,
    run: dwell.Run,
    shown: Mapping[str, Displayed],
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[type, object]:
    """An object of every public class: results, what they are made of, and the rest by hand."""
    ints = np.zeros((100, 4), np.int64)
    instants = Instants(ints, ints, ints)
    controller = Controller(canonical, "cusum+corrected")
    known = QoS(20.0, 0.0, dict.fromkeys(canonical.fabric.nodes, 0.5))
    proposal = controller.propose_by(known, dict.fromkeys(canonical.fabric.nodes, 0.5))
    table = TraceTable("drive.csv", {"rtt_ms": np.arange(5_000.0)})
    policies = (*POLICIES, "LOC")
    files = ("fan-in.yaml", "cloud.yaml", "live/cell.yaml", "visual_servoing/testbed.yaml")
    trees: list[object] = [
        *shown.values(),
        *(dwell.load(EXAMPLES / name) for name in files),
        dwell.draw(canonical, seed=1, windows=40, scenario="network-impairment"),
        *(policy_by_name(name, canonical) for name in policies),
        *(estimator_by_name(name, canonical) for name in ("profile", "shadow", "scaling")),
        *(controller, controller.estimator, controller.course, proposal),
        Presence.of(canonical),
        *(
            FallbackRound(["LOC"]),
            Failures.of(canonical),
            ShadowPlan(0, 9, [0.05, 0.05], [[1], [0]]),
        ),
        Guard(["LOC"], patience_ns=3, probe_cycles=30, placement="SO"),
        CellGuard(canonical),
        Probation(30, health_cycles=10, patience_ns=1),
        ClosedWindow(ints[:, 0], ints[:, 0], 1, 0, np.zeros((3, 3)), LookedAt(0, 0, 1)),
        *(instants, Evidence.of(1, ints[:, 0], ints[:, 0], instants, ints[:, 0], instants)),
        Trace(table, "rtt_ms"),
        Hindsight(),
        dwell.simulate_fleet(
            Fleet("pair", (FleetEntry(canonical, 2),)), windows=6, policy="LOC", coordination="none"
        ),
        capacity_of(
            Fleet("pair", (FleetEntry(canonical, 1),), ("E",)),
            policy="SO",
            most=2,
            seeds=(1,),
            cycles=100,
            processes=1,
        ),
        Limiting("node", "E", 0.9),
        Shard(2, 4),
        mean_interval([1.0, 2.0, 3.0]),
        *(run.arrays("cycles"), run.arrays("cycles").names("placement")),
        Journal(tmp_path_factory.mktemp("journal"), run="r", meta={}, columns={}),
    ]
    seen: dict[type, object] = {}
    for tree in trees:
        walk(tree, seen)
    return seen


def test_every_public_class_is_looked_at(objects: Mapping[type, object]) -> None:
    unseen = {kind.__name__ for kind in public_classes() - objects.keys()}
    assert unseen == FEW_NUMBERS


def test_a_representation_is_short_and_says_what_it_is(objects: Mapping[type, object]) -> None:
    too_long = {}
    # A mapping shows its items, as a dict does.
    for kind in public_classes() & objects.keys() - {FrozenDict}:
        lines = repr(objects[kind]).splitlines()
        if len(lines) > LINES or max(map(len, lines)) > CHARACTERS:
            too_long[kind.__name__] = (len(lines), max(map(len, lines)))
        assert " object at 0x" not in lines[0], kind
    assert not too_long


NAMES = ("problem", "run", "comparison", "study", "saved study", "validation")


@pytest.mark.parametrize("name", NAMES)
def test_a_summary_fits_a_screen(name: str, shown: Mapping[str, Displayed]) -> None:
    lines = shown[name].summary().splitlines()
    assert 3 <= len(lines) <= SCREEN_LINES
    assert max(map(len, lines)) <= SCREEN_COLUMNS


class Reader(HTMLParser):
    """Follows what is opened and closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("br",):
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(str(value))
            if name in ("href", "src", "xlink:href"):
                self.links.append(str(value))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.open.pop()


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_stands_by_itself_in_a_notebook(
    name: str, shown: Mapping[str, Displayed]
) -> None:
    first, again = Reader(), Reader()
    html = shown[name]._repr_html_()
    first.feed(html)
    again.feed(shown[name]._repr_html_())
    assert not first.open
    assert "<svg" in html
    assert "<script" not in html
    assert all(link.startswith("#shown-") for link in first.links)
    # A notebook has many of them.
    assert not set(first.ids) & set(again.ids)


@pytest.mark.parametrize("name", NAMES)
def test_without_what_draws_there_are_tables(
    name: str, shown: Mapping[str, Displayed], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "vl_convert", None)
    html = shown[name]._repr_html_()
    Reader().feed(html)
    assert "<svg" not in html
    assert "<table>" in html or "V_D" in html


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (12.3456, 2, "12.35"),
        (0.5, 2, "0.50"),
        (0.0123, 2, "0.012"),
        (0.0042, 1, "0.0042"),
        (0.0000014, 1, "0.000001"),
        (1e-9, 2, "0.00"),
        (0.0, 2, "0.00"),
        (1234.5, 1, "1234.5"),
        (math.inf, 2, "∞"),
    ],
)
def test_of_a_time_two_digits_count_down_to_a_nanosecond(
    value: float, decimals: int, text: str
) -> None:
    assert milliseconds(value, decimals) == text
