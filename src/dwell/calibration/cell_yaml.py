"""Cell YAML: the part of a cell that replays the samples of a profile."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import yaml

from dwell.calibration.profile_file import Measurement


def cell_yaml(file: Path, measurements: Sequence[Measurement]) -> str:
    """Return the parts of a cell that replay `measurements`.

    Parameters
    ----------
    file : Path
        The profile, relative to the folder of the cell file.
    measurements : sequence of Measurement

    Returns
    -------
    str
        YAML with ``tasks``, ``links`` or both.
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
        yield f"  {_flow([task])[1:-1]}:"
        yield "    on:"
        for one in nodes:
            threads = max(1, round(one.about["cores_used"]))
            more = {"threads": threads} if threads > 1 else {}
            on = {one.about["node"]: {"exec_ms": replay(file, one.name), **more}}
            yield f"      {_flow(on)[1:-1]}"


def _links(file: Path, measurements: Sequence[Measurement]) -> Iterator[str]:
    links = [one for one in measurements if one.about.get("kind") == "link"]
    if links:
        yield "links:"
    for one in links:
        ends = {"from": one.about["from"], "to": one.about["to"]}
        rate = one.about["rate_mbps"]
        # Four digits.
        more = {} if rate is None else {"rate_mbps": float(f"{rate:.4g}")}
        yield f"  - {_flow({**ends, 'delay_ms': replay(file, one.name), **more})}"


def replay(file: Path, column: str) -> dict[str, object]:
    """Return the process that replays a column of a profile, as a cell file has it."""
    return {"trace": {"file": file.as_posix(), "column": column, "by": "row", "wrap": True}}


def _flow(value: Mapping[str, object] | Sequence[str]) -> str:
    """Return a mapping or sequence as one line of YAML."""
    return yaml.safe_dump(
        value, default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True
    ).strip()
