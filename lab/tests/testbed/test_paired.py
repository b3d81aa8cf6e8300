"""Rows of execution times in which the tasks of a node keep what they had in common."""

from __future__ import annotations

import numpy as np

from dwell_lab.testbed.paired import Part, paired


def part(first: int, times_ms: list[float], step: int = 1) -> Part:
    cycles = first + step * np.arange(len(times_ms))
    return Part(cycles, np.array(times_ms))


def test_tasks_of_one_run_share_their_cycles() -> None:
    found = paired(
        {
            ("see", "R1"): {"a": part(5, [1.0, 2.0, 3.0, 4.0])},
            # No job in cycle 6: it is as in the one before.
            ("find", "E"): {"a": Part(np.array([5, 7, 8]), np.array([10.0, 30.0, 40.0]))},
        }
    )
    assert found["see", "R1"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert found["find", "E"].tolist() == [10.0, 10.0, 30.0, 40.0]


def test_a_run_in_which_tasks_were_elsewhere_takes_their_rows_together_from_another() -> None:
    found = paired(
        {
            ("see", "R1"): {"loc": part(0, [1.0, 2.0]), "so": part(0, [3.0, 4.0, 5.0])},
            ("find", "R1"): {"loc": part(0, [10.0, 20.0])},
            ("find", "E"): {"so": part(0, [30.0, 40.0, 50.0])},
            ("plan", "E"): {"so": part(0, [300.0, 400.0, 500.0])},
        }
    )
    assert found["see", "R1"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    # The slowest rows of the other run, where the task that both have was slowest.
    assert found["find", "R1"].tolist() == [10.0, 20.0, 10.0, 20.0, 20.0]
    assert found["find", "E"].tolist() == [30.0, 40.0, 30.0, 40.0, 50.0]
    # Tasks of a node stay with each other wherever their rows are from.
    assert (found["plan", "E"] == 10 * found["find", "E"]).all()


def test_rows_that_stand_in_are_of_cycles_as_slow_on_the_same_cpu() -> None:
    parts = {
        ("see", "R1"): {"loc": part(0, [1.0, 2.0, 3.0, 4.0]), "so": part(0, [5.0, 1.0, 3.0])},
        ("find", "R2"): {"loc": part(0, [40.0, 10.0, 30.0, 20.0])},
        ("find", "E"): {"so": part(0, [7.0, 8.0, 9.0])},
    }
    shared = paired(parts, {"R1": 0, "R2": 0, "E": 1})
    assert shared["find", "R2"].tolist() == [40.0, 10.0, 30.0, 20.0, 20.0, 40.0, 30.0]
    # Nothing on E was there in the first run: its rows come in their order.
    assert shared["find", "E"].tolist() == [7.0, 8.0, 9.0, 7.0, 7.0, 8.0, 9.0]
    apart = paired(parts)
    assert apart["find", "R2"].tolist() == [40.0, 10.0, 30.0, 20.0, 40.0, 10.0, 30.0]


def test_rows_that_stand_in_go_on_where_they_ended() -> None:
    found = paired(
        {
            ("see", "R1"): {name: part(0, [1.0, 2.0]) for name in ("a", "b", "c")},
            ("find", "E"): {"d": part(0, [1.0, 2.0, 3.0])},
        }
    )
    assert found["find", "E"].tolist() == [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 1.0, 2.0, 3.0]
    assert len(found["see", "R1"]) == 9
