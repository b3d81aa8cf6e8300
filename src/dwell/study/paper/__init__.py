"""The whole Phase 1 of the paper: its table, its sensitivities and its four questions."""

from dwell.study.chapter import Chapter, Figure, Panel, Table
from dwell.study.paper.cell import paper_problem
from dwell.study.paper.paper import CHAPTERS, Paper, paper_study
from dwell.study.paper.running import Runner, Scale

__all__ = [
    "CHAPTERS",
    "Chapter",
    "Figure",
    "Panel",
    "Paper",
    "Runner",
    "Scale",
    "Table",
    "paper_problem",
    "paper_study",
]
