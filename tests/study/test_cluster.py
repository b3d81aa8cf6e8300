"""The same study on a Dask cluster: a real scheduler, and two workers that are processes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from dwell.errors import SimulationError
from dwell.study import Study, StudyResult, load_study, run_study
from dwell.study.cluster import spread_on_dask
from tests.cli.small_cell import SMALL
from tests.study.test_study import make_study
from tests.study.test_study_folder import assert_same_files, parts_in

distributed: Any = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Return a cluster of this machine."""
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=":0",
        local_directory=str(tmp_path_factory.mktemp("dask")),
    ) as cluster:
        yield cluster


def stop(done: int, _: int) -> None:
    if done >= 4:
        raise KeyboardInterrupt


def stopped_and_resumed(study: Study, cluster: Any, out: Path) -> StudyResult:
    """Do two items of a study on a cluster, and the others in a second attempt."""
    with pytest.raises(KeyboardInterrupt):
        run_study(study, folder=out, dask=cluster.scheduler_address, progress=stop)
    known = parts_in(out)
    assert len(known) == 2 * len(study.players)
    result = run_study(study, folder=out, dask=cluster.scheduler_address)
    assert parts_in(out).items() >= known.items(), "a finished item was repeated"
    return result


def test_a_cluster_ends_with_the_same_bytes(cluster: Any, tmp_path: Path) -> None:
    study = make_study(references=True)
    run_study(study, folder=tmp_path / "local", processes=1)
    stopped_and_resumed(study, cluster, tmp_path / "cluster")
    assert_same_files(tmp_path / "cluster", tmp_path / "local")


def test_fleets_on_a_cluster_end_with_the_same_bytes(cluster: Any, tmp_path: Path) -> None:
    (tmp_path / "small.yaml").write_text(SMALL)
    (tmp_path / "pair.yaml").write_text(
        "dwell-fleet: 1\nname: pair\nshared: [E]\ncells:\n"
        "  - {cell: small.yaml, count: 2, scenario: stress}\n"
    )
    (tmp_path / "study.yaml").write_text(
        "dwell-study: 1\nname: fleets\nfleet: pair.yaml\nscenarios: [stress]\nwindows: 8\n"
        "seeds: 2\npolicies: {edge: OFF, dtp: dtp+profile}\n"
        "parameters: {fleet.count: [1, 3], fleet.coordination: [none, ledger]}\n"
    )
    study = load_study(tmp_path / "study.yaml")
    local = run_study(study, folder=tmp_path / "local", processes=2)
    found = stopped_and_resumed(study, cluster, tmp_path / "cluster")
    assert_same_files(tmp_path / "cluster", tmp_path / "local")
    assert_frame_equal(found.runs, local.runs)
    assert found.runs["cells"].to_list() == [1] * 8 + [3] * 8


def test_workers_make_policies_and_estimators_of_the_users_own(
    cluster: Any, tmp_path: Path
) -> None:
    (tmp_path / "hall_policy.py").write_text(
        "from dwell.estimators import Profile\n\n\n"
        "class Last:\n"
        "    def decide(self, *, observed, estimates):\n"
        "        return list(estimates)[-1]\n\n\n"
        "class Mine(Profile):\n"
        "    @classmethod\n"
        "    def from_problem(cls, problem):\n"
        "        return cls(problem, samples=100)\n"
    )
    (tmp_path / "small.yaml").write_text(SMALL)
    (tmp_path / "study.yaml").write_text(
        "dwell-study: 1\nname: own\ncell: small.yaml\nwindows: 5\nseeds: 3\npolicies:\n"
        "  LOC: LOC\n  last: hall_policy:Last\n"
        "  both: {policy: 'hall_policy:Last', estimator: 'hall_policy:Mine'}\n"
    )
    study = load_study(tmp_path / "study.yaml")
    run_study(study, folder=tmp_path / "local", processes=1)
    found = run_study(study, folder=tmp_path / "cluster", dask=cluster.scheduler_address)
    assert_same_files(tmp_path / "cluster", tmp_path / "local")
    moved = found.runs.group_by("policy").agg(pl.col("migrations").max())
    assert dict(moved.iter_rows()) == {"LOC": 0, "last": 1, "both": 1}


def test_work_is_spread_over_the_workers(cluster: Any) -> None:
    address = cluster.scheduler_address
    found: dict[int, str] = {}
    spread_on_dask(worker_of, list(range(8)), address=address, take=found.__setitem__)
    assert found.keys() == set(range(8))
    assert len(set(found.values())) == 2


def worker_of(_: int) -> str:
    time.sleep(0.02)  # long enough for the other one to take the next
    name: str = distributed.get_worker().name
    return name


def test_the_rest_of_a_unit_is_done_on_the_cluster_too(cluster: Any) -> None:
    found: list[int] = []
    spread_on_dask(
        first_of,
        [(1, 2, 3), (4,)],
        address=cluster.scheduler_address,
        take=lambda _, result: found.append(result[0]),
        rest=lambda result: result[1] or None,
    )
    assert sorted(found) == [1, 2, 3, 4]


def first_of(values: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    return values[0], values[1:]


def test_an_error_on_a_worker_arrives_as_it_is(cluster: Any) -> None:
    with pytest.raises(ZeroDivisionError):
        spread_on_dask(
            (1).__truediv__, [0], address=cluster.scheduler_address, take=lambda *_: None
        )


def test_a_worker_is_no_scheduler(cluster: Any) -> None:
    address = cluster.workers[0].worker_address
    with pytest.raises(SimulationError, match="is a Dask Worker; name the scheduler"):
        run_study(make_study(), dask=address)


@pytest.mark.parametrize("address", ["nowhere", "strange://x:1", "127.0.0.1:1"])
def test_an_address_where_no_scheduler_answers(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dwell.study.cluster.ANSWER_S", 0.2)
    with pytest.raises(SimulationError, match="no Dask scheduler answers at"):
        run_study(make_study(), dask=address)


def test_a_scheduler_without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dwell.study.cluster.WORKER_S", 0.2)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as empty,
        pytest.raises(
            SimulationError, match=r"has no workers; start one with `dask worker \S+ --nthreads 1`"
        ),
    ):
        run_study(make_study(), dask=empty.scheduler_address)
