"""Answers are found once, and few are kept."""

from __future__ import annotations

from dwell.estimators.remembered import Remembered


def test_an_answer_is_found_once_and_the_oldest_is_dropped() -> None:
    remembered, found = Remembered[int, str](2), list[int]()

    def answer(question: int) -> str:
        def find() -> str:
            found.append(question)
            return str(question)

        return remembered.answer(question, find)

    assert [answer(one) for one in (1, 1, 2, 3, 1)] == ["1", "1", "2", "3", "1"]
    assert found == [1, 2, 3, 1]
    assert remembered.known == {3: "3", 1: "1"}


def test_answers_of_another_process_are_known() -> None:
    remembered = Remembered[int, str](2)
    remembered.add({1: "one", 2: "two", 3: "three"})
    assert remembered.known == {2: "two", 3: "three"}
    assert remembered.answer(3, str) == "three"
