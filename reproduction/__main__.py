"""Ask the paper's questions: `make paper`, or `python -m reproduction --help`."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import dwell
from dwell.study import Study, StudyResult, run_study
from reproduction.cell import paper_cell
from reproduction.page import Question, page
from reproduction.questions import QUESTIONS
from reproduction.scale import FULL, QUICK, TINY, Scale

SCALES = {"full": FULL, "quick": QUICK, "tiny": TINY}
REAL = "real"


def main(words: list[str]) -> int:
    """Ask, write tables and the page, and return the exit code."""
    asked = _parser().parse_args(words)
    scale = SCALES[asked.scale]
    if asked.seeds is not None:
        scale = replace(scale, seeds=asked.seeds)
    out: Path = asked.out or Path("studies", f"paper-{asked.scale}")

    def run(study: Study) -> StudyResult:
        print(f"{study.name}: {study.runs} runs", file=sys.stderr, flush=True)
        folder = out / "runs" / study.name
        return run_study(study, folder=folder, processes=asked.processes, dask=asked.dask)

    names = asked.only or [name for name in QUESTIONS if name != REAL or asked.real]
    try:
        done = [_ask(name, scale, run, asked.real, out) for name in names]
    except dwell.DwellError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(
            f"interrupted: finished runs stay in {out}; the same command goes on", file=sys.stderr
        )
        return 130
    file = out / "report.html"
    file.write_text(page(done, scale=asked.scale, version=dwell.__version__), encoding="utf-8")
    print(f"report: {file}")
    return 0


def _ask(name: str, scale: Scale, run: object, traces: Path | None, out: Path) -> Question:
    """Answer one question and write its tables."""
    module = import_module(f"reproduction.questions.{name}")
    answer = module.answer(traces if name == REAL else paper_cell(), scale, run)
    folder = out / "tables" / name
    folder.mkdir(parents=True, exist_ok=True)
    answer.verdicts.write_csv(folder / "verdicts.csv")
    for title, frame in answer.tables.items():
        frame.write_csv(folder / f"{title.split(':')[0].lower().replace(' ', '-')}.csv")
    return Question(name, module.TITLE, answer)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m reproduction",
        description="The paper's questions; goes on where it stopped.",
    )
    parser.add_argument(
        "--scale", choices=SCALES, default="full", help="how much is simulated; full takes hours"
    )
    parser.add_argument(
        "--only", nargs="+", choices=QUESTIONS, metavar="QUESTION", help=", ".join(QUESTIONS)
    )
    parser.add_argument("--seeds", type=int, metavar="N", help="seeds 1 to N of a comparison")
    parser.add_argument("--processes", type=int, metavar="N", help="one a CPU if not given")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a cluster that does the work"
    )
    parser.add_argument("--real", type=Path, metavar="FOLDER", help="recorded traces, for `real`")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="studies/paper-SCALE if not given"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
