"""Parts of a study: small, few, found again after a stop, and played again where code changed."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from polars.testing import assert_frame_equal

import dwell
from dwell.errors import SimulationError
from dwell.study import Contender, Point, Study, open_study, run_study
from dwell.study.parts import BATCH_RUNS, batches_of, play_and_write
from dwell.study.player import Batch, Player
from dwell.study.runner import open_parts
from tests.cli.small_cell import SMALL
from tests.study.test_study import make_study

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
TINY = make_study(
    contenders=make_study().contenders[:1], scenarios=("baseline",), seeds=tuple(range(1, 601))
)


def parts_in(folder: Path) -> list[Path]:
    return sorted((folder / "parts").glob("*.parquet"))


def test_many_tiny_runs_take_few_small_parts(tmp_path: Path) -> None:
    """A run is 0.3 kB on the disk, tables included; one file per run had 16 kB."""
    run_study(TINY, folder=tmp_path / "out", processes=1)
    parts = parts_in(tmp_path / "out")
    runs = [len(pl.read_parquet(part, columns=["seed"])) for part in parts]
    assert sum(runs) == 600
    assert len(parts) < 60
    files = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 600 * 1000


@pytest.mark.parametrize(("processes", "size"), [(1, 150), (4, 38), (1000, 1)])
def test_batches_are_enough_for_all_processes(processes: int, size: int) -> None:
    left = dict.fromkeys(range(600), TINY.players)
    batches = batches_of(TINY, left, processes)
    assert max(len(batch.items) for batch in batches) == size
    assert [item for batch in batches for item in batch.items] == [*TINY.items()]


def test_a_batch_has_so_many_runs_at_most() -> None:
    many = replace(TINY, seeds=tuple(range(1, 10_001)))
    batches = batches_of(many, dict.fromkeys(range(10_000), many.players), 1)
    assert max(len(batch.items) for batch in batches) == BATCH_RUNS


def test_a_batch_has_items_that_the_same_players_left() -> None:
    study = make_study()
    left = {0: ("LOC", "dtp"), 1: ("LOC", "dtp"), 2: ("dtp",), 4: ("dtp",), 5: ("dtp",)}
    batches = batches_of(study, left, 1)
    assert {place: batch.players for batch in batches for place in places(batch)} == left
    assert all(len(set(places(batch))) == len(batch.items) for batch in batches)


def places(batch: Batch) -> range:
    return range(batch.first, batch.end)


def resumed(study: Study, folder: Path) -> tuple[int, ...]:
    """Go on with a study; the runs that were there at the begin and after each batch."""
    seen: list[int] = []
    run_study(study, folder=folder, processes=1, progress=lambda done, _: seen.append(done))
    return tuple(seen)


def test_a_part_that_is_missing_is_played_for_its_contender_alone(tmp_path: Path) -> None:
    study = make_study(references=True)
    whole = run_study(study, folder=tmp_path / "out", processes=1)
    policies = {part: pl.read_parquet(part)["policy"][0] for part in parts_in(tmp_path / "out")}
    gone = next(part for part, policy in policies.items() if policy == "dtp")
    content = gone.read_bytes()
    others = {part: part.stat().st_mtime_ns for part in policies if part != gone}
    gone.unlink()
    assert resumed(study, tmp_path / "out") == (10, 11, 12)
    assert {part: part.stat().st_mtime_ns for part in others} == others
    again = pl.concat(
        pl.read_parquet(part) for part in parts_in(tmp_path / "out") if part not in others
    )
    gone.write_bytes(content)
    assert_frame_equal(again, pl.read_parquet(gone))
    assert_frame_equal(open_study(tmp_path / "out").runs, whole.runs)


def test_parts_that_share_items_count_once(tmp_path: Path) -> None:
    """A worker may write a part after its study was killed, while the next attempt plays on."""
    study = make_study()
    whole = run_study(study, processes=1)
    with open_parts(study, tmp_path / "out") as parts:
        player = Player(study)
        for first, count in ((0, 3), (1, 1), (2, 4)):
            (batch,) = batches_of(
                study, dict.fromkeys(range(first, first + count), study.players), 1
            )[:1]
            wider = replace(batch, items=study.items()[first : first + count])
            play_and_write(player, parts.folder, parts.digests, wider)
        parts.look()
        assert (parts.done, parts.total) == (6, 12)
    found = run_study(study, folder=tmp_path / "out", processes=1)
    for name in ("runs", "costs", "latencies"):
        assert_frame_equal(getattr(found, name), getattr(whole, name), check_exact=True)
    with open_parts(study, tmp_path / "out") as parts:
        assert sorted(parts.files) == parts_in(tmp_path / "out")


def test_tables_of_an_earlier_state_do_not_stay(tmp_path: Path) -> None:
    """A folder in which a part is played again is not finished until it is there."""
    study, out = make_study(), tmp_path / "out"
    run_study(study, folder=out, processes=1)
    parts_in(out)[0].unlink()

    def stop(done: int, of: int) -> None:
        if done == of:
            raise SimulationError("stopped")

    with pytest.raises(SimulationError, match="stopped"):
        run_study(study, folder=out, processes=1, progress=stop)
    assert not (out / "runs.parquet").exists()


def test_a_digest_is_that_of_a_contender_and_the_study(tmp_path: Path) -> None:
    def digests(study: Study, name: str) -> dict[str, str]:
        with open_parts(study, tmp_path / name) as parts:
            return dict(parts.digests)

    one = digests(make_study(), "one")
    assert one == digests(make_study(), "again")
    assert len({*one.values()}) == 2
    fewer = digests(make_study(contenders=make_study().contenders[:1]), "fewer")
    assert fewer["LOC"] == one["LOC"]
    changes: list[dict[str, Any]] = [{"windows": 7}, {"seeds": (1, 2)}, {"references": True}]
    for number, change in enumerate(changes):
        assert digests(make_study(**change), str(number))["LOC"] != one["LOC"]


POLICY = """\
class Last:
    def decide(self, *, observed, estimates):
        return list(estimates)[-1]
"""


def test_an_edit_that_this_process_has_not_imported_is_refused(tmp_path: Path) -> None:
    """A notebook would play the old code, and keep its runs as those of the new one."""
    (tmp_path / "small.yaml").write_text(SMALL)
    module = tmp_path / "hall_edited.py"
    module.write_text(POLICY)
    problem = dwell.load(tmp_path / "small.yaml")
    study = make_study(
        points=(Point({}, problem),),
        scenarios=("baseline",),
        contenders=(Contender("mine", "hall_edited:Last"),),
    )
    run_study(study, folder=tmp_path / "out", processes=1)
    known = parts_in(tmp_path / "out")
    module.write_text(POLICY.replace("[-1]", "[0]"))
    with pytest.raises(SimulationError, match="hall_edited: its source has changed since this"):
        run_study(study, folder=tmp_path / "out", processes=1)
    assert parts_in(tmp_path / "out") == known
    module.write_text(POLICY)
    assert resumed(study, tmp_path / "out") == (3,)


def test_the_source_of_an_objects_class_is_in_its_digest(tmp_path: Path) -> None:
    """As of a class that is named: an edit plays its contender again."""
    script = tmp_path / "script.py"
    policy = POLICY.replace("Last", "Mine")
    (tmp_path / "hall_object.py").write_text(policy)
    script.write_text(SCRIPT)
    before = subprocess.run(
        [sys.executable, script], check=True, capture_output=True, text=True, env=ENVIRONMENT
    )
    (tmp_path / "hall_object.py").write_text(policy.replace("[-1]", "[0]"))
    after = subprocess.run(
        [sys.executable, script], check=True, capture_output=True, text=True, env=ENVIRONMENT
    )
    first, second = (one.stdout.splitlines()[0] for one in (before, after))
    assert (first, second) == ("[0, 2, 4]", "[2, 3, 4]")


SCRIPT = """\
from pathlib import Path

import hall_object

from dwell.study import Contender, run_study
from tests.study.test_study import make_study

study = make_study(
    scenarios=("baseline",),
    seeds=(1, 2),
    contenders=(Contender("LOC", "LOC"), Contender("mine", hall_object.Mine())),
)
seen = []
folder = Path(__file__).parent / "out"
run_study(study, folder=folder, processes=1, progress=lambda done, _: seen.append(done))
print(seen)
"""
