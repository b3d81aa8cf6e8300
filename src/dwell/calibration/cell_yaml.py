"""Cell YAML: the part of a cell that replays the samples of a profile."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from dwell.calibration.profile_file import Measurement

# What YAML reads as this very text also inside of { }.
PLAIN = re.compile(r"[A-Za-z_][\w./+@-]*(?:->[\w.+-]+)?")
# Words that YAML, of any version, takes for something else.
RESERVED = re.compile(r"(?i)null|true|false|yes|no|on|off|y|n|\.inf|\.nan")


def cell_yaml(file: Path, measurements: Sequence[Measurement]) -> str:
    """Return the parts of a cell that replay `measurements`.

    Parameters
    ----------
    file : Path
        The profile; the cell takes it for relative to its own folder.
    measurements : sequence of Measurement

    Returns
    -------
    str
        YAML with ``tasks`` and ``links``, whichever there are.
    """
    return "\n".join([*_tasks(file, measurements), *_links(file, measurements)]) + "\n"


def _tasks(file: Path, measurements: Sequence[Measurement]) -> Iterator[str]:
    tasks: dict[str, list[Measurement]] = {}
    for one in measurements:
        if one.about.get("kind") == "task":
            tasks.setdefault(one.about["task"], []).append(one)
    if tasks:
        yield "tasks:"
    for task, nodes in tasks.items():
        yield f"  {_scalar(task)}:"
        yield "    on:"
        for one in nodes:
            threads = max(1, round(one.about["cores_used"]))
            more = f", threads: {threads}" if threads > 1 else ""
            yield f"      {_scalar(one.about['node'])}: {{exec_ms: {_trace(file, one.name)}{more}}}"


def _links(file: Path, measurements: Sequence[Measurement]) -> Iterator[str]:
    links = [one for one in measurements if one.about.get("kind") == "link"]
    if links:
        yield "links:"
    for one in links:
        ends = f"from: {_scalar(one.about['from'])}, to: {_scalar(one.about['to'])}"
        rate = one.about["rate_mbps"]
        # Four digits, without an exponent.
        more = "" if rate is None else f", rate_mbps: {float(f'{rate:.4g}'):.15g}"
        yield f"  - {{{ends}, delay_ms: {_trace(file, one.name)}{more}}}"


def _trace(file: Path, column: str) -> str:
    return (
        f"{{trace: {{file: {_scalar(file.as_posix())}, column: {_scalar(column)}, "
        "by: row, wrap: true}}"
    )


def _scalar(text: str) -> str:
    """Return text as YAML reads it back: as it is, or quoted as JSON (which is YAML)."""
    if PLAIN.fullmatch(text) and not RESERVED.fullmatch(text):
        return text
    return json.dumps(text, ensure_ascii=False)
