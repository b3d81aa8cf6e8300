"""Ask the paper's questions: `make paper`, or `python -m reproduction --help`."""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import dwell
from dwell.report import study_html
from dwell.study import Study, StudyResult, open_study, run_study
from reproduction.answers import RESEARCH, page_of, write
from reproduction.cell import paper_cell
from reproduction.page import Question, page
from reproduction.questions import QUESTIONS, Run
from reproduction.scale import Scale, scale_of

SCALES = ("full", "medium", "quick", "tiny")
REAL = "real"


def main(words: list[str]) -> int:
    """Ask, write tables and the page, and return the exit code."""
    parser = _parser()
    asked = parser.parse_args(words)
    if REAL in (asked.only or ()) and asked.real is None:
        parser.error(
            f"question {REAL!r} replays recorded traces; say where they are: --real FOLDER"
        )
    scale = scale_of(asked.scale)
    if asked.seeds is not None:
        scale = replace(scale, seeds=asked.seeds)
    out: Path = asked.out or Path("studies", f"paper-{asked.scale}")
    drawn: list[str] = []

    def run(study: Study) -> StudyResult:
        print(f"{study.name}: {study.runs} runs", file=sys.stderr, flush=True)
        folder = out / "runs" / study.name
        result = run_study(study, folder=folder, processes=asked.processes, dask=asked.dask)
        if asked.pictures:
            (folder / "report.html").write_text(study_html(open_study(folder)), encoding="utf-8")
            drawn.append(study.name)
        return result

    names = asked.only or [name for name in QUESTIONS if name != REAL or asked.real]
    try:
        done = [_ask(name, scale, run, asked.real, out) for name in names]
        mapped = {one.name: one.answer.cells for one in done if one.answer.cells is not None}
        answers = {
            name: mapped[one.question] for name, one in RESEARCH.items() if one.question in mapped
        }
        write(answers, out)
        text = page(
            done,
            answers=page_of(answers),
            scale=asked.scale,
            version=dwell.__version__,
            pictures=drawn,
        )
        (out / "report.html").write_text(text, encoding="utf-8")
    except (dwell.DwellError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        print(f"error: {error.name} is not installed; `make env` installs it", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(
            f"interrupted: finished runs stay in {out}; the same command goes on", file=sys.stderr
        )
        return 130
    print(f"report: {out / 'report.html'}")
    return 0


def _ask(name: str, scale: Scale, run: Run, traces: Path | None, out: Path) -> Question:
    """Answer one question and write its tables."""
    module = import_module(f"reproduction.questions.{name}")
    answer = module.answer(traces if name == REAL else paper_cell(), scale, run)
    folder = out / "tables" / name
    folder.mkdir(parents=True, exist_ok=True)
    answer.verdicts.write_csv(folder / "verdicts.csv")
    for title, frame in answer.tables.items():
        name_of_file = re.sub(r"[^a-z0-9]+", "-", title.partition(":")[0].lower()).strip("-")
        frame.write_csv(folder / f"{name_of_file}.csv")
    return Question(name, module.TITLE, answer)


def _count(text: str) -> int:
    """Read a number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; it must be a number from 1 on")
    return int(text)


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
    parser.add_argument("--seeds", type=_count, metavar="N", help="seeds 1 to N of a comparison")
    parser.add_argument("--processes", type=_count, metavar="N", help="one a CPU if not given")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a cluster that does the work"
    )
    parser.add_argument("--real", type=Path, metavar="FOLDER", help="recorded traces, for `real`")
    parser.add_argument(
        "--pictures", action="store_true", help="also a page of figures for every study"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="studies/paper-SCALE if not given"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
