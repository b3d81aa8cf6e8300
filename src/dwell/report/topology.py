"""The topology of a cell: nodes, the links between them, and the tasks that may run on each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from dwell.display import write_number
from dwell.model import Link, Problem, Trace
from dwell.model.bounds import counted
from dwell.report.charts import layer, quantity
from dwell.report.figure import Figure, Spec
from dwell.report.formatting import write_ms
from dwell.report.palette import INK, MUTED, PAPER, SHADE

#: Largest width of a node; height of a line of text; room between nodes and between rows; pixels.
NODE_PX, LINE_PX, GAP_PX, ROWS_PX = 150.0, 15.0, 16.0, 44.0
#: Widths of the picture on large and on small screens, pixels.
WIDTHS = (620.0, 360.0)
#: Rows of nodes from the top.
TIERS = ("cloud", "edge", "robot")
#: Most links with a label each, and least room for a label between neighbours, pixels.
LABELLED, LABEL_PX = 12, 130.0


class _Box(NamedTuple):
    """Place of a node, pixels."""

    x: float
    y: float
    width: float
    height: float

    @property
    def middle(self) -> tuple[float, float]:
        return self.x + self.width / 2, self.y + self.height / 2


def topology(problem: Problem, slug: str = "topology", remark: str = "") -> Figure:
    """Draw a cell's topology: the cloud above, the edge, and the robots in the order of the cell.

    A line shows the links of both directions, with the delay and rate of the link that the cell
    declares first. A node lists the tasks that it can run, anchored tasks in parentheses.
    `remark` begins the caption.
    """
    import polars as pl

    nodes = sorted(problem.fabric.nodes.values(), key=lambda node: TIERS.index(node.tier))
    texts = {
        node.name: [
            f"{node.name}: {node.tier}, {counted(node.cores, 'core')}",
            *_tasks(problem, node.name),
        ]
        for node in nodes
    }
    tiers = {node.name: node.tier for node in nodes}
    pairs: dict[frozenset[str], Link] = {}
    for link in problem.fabric.links.values():
        pairs.setdefault(frozenset((link.source, link.target)), link)
    links = [(link.source, link.target, _link(link)) for link in pairs.values()]
    different = {text for *_, text in links}
    labelled = len(different) > 1 and len(links) <= LABELLED
    boxes = [(node, line, text) for node, some in texts.items() for line, text in enumerate(some)]
    frames = {
        "boxes": pl.DataFrame(boxes, schema=["node", "line", "text"], orient="row"),
        "links": pl.DataFrame(
            links, schema=dict.fromkeys(("source", "target", "text"), pl.String), orient="row"
        ),
    }
    caption = [remark] if remark else []
    caption.append("A node lists the tasks that it can run; in parentheses: only there.")
    if len(different) == 1:
        caption.append(f"Each link: {different.pop()}.")

    def draw(width: float) -> Spec:
        places, height = _places(tiers, texts, min(width, WIDTHS[0]))
        lines = [_line(places[one], places[other]) for one, other, _ in links]
        labels = list(_labels(places, links)) if labelled else []
        return {
            "width": min(width, WIDTHS[0]),
            "height": height,
            "encoding": {
                "x": _scale("x", min(width, WIDTHS[0])),
                "y": _scale("y", height, reverse=True),
            },
            "layer": list(_layers(places, texts, lines, labels)),
        }

    title = f"Topology of {problem.name}"
    return Figure(slug, title, frames, draw, " ".join(caption), widths=WIDTHS)


def _scale(field: str, length: float, **more: bool) -> Spec:
    return quantity(field, None, axis=None, scale={"domain": [0, length], "nice": False, **more})


def _places(
    tiers: Mapping[str, str], texts: Mapping[str, list[str]], width: float
) -> tuple[dict[str, _Box], float]:
    """Return the places of nodes in rows by tier, and the height of all rows."""
    size = min(NODE_PX, (width - GAP_PX) / 2)
    most = max(1, int((width + GAP_PX) / (size + GAP_PX)))
    places: dict[str, _Box] = {}
    y = 0.0
    for tier in TIERS:
        mine = [name for name, of in tiers.items() if of == tier]
        for begin in range(0, len(mine), most):
            row = mine[begin : begin + most]
            height = 12 + LINE_PX * max(len(texts[name]) for name in row)
            # One node has the middle, several are spread from one end to the other.
            step = (width - size) / (len(row) - 1) if len(row) > 1 else 0.0
            left = 0.0 if len(row) > 1 else (width - size) / 2
            if len(row) == 1 and tier == "cloud":
                # A cloud on the right keeps its links to robots visible.
                left = width - size
            for i, name in enumerate(row):
                places[name] = _Box(left + i * step, y, size, height)
            y += height + ROWS_PX
    return places, y - ROWS_PX


def _line(one: _Box, other: _Box) -> dict[str, float]:
    (x, y), (x2, y2) = one.middle, other.middle
    return {"x": x, "y": y, "x2": x2, "y2": y2}


def _labels(
    places: Mapping[str, _Box], links: list[tuple[str, str, str]]
) -> Iterator[dict[str, float | str]]:
    """Yield the labels of links: above the lower node, or between neighbours with enough room."""
    above: Counter[str] = Counter()
    for one, other, text in links:
        upper, lower = sorted((one, other), key=lambda name: (places[name].y, places[name].x))
        a, b = places[upper], places[lower]
        if a.y == b.y:
            if b.x - a.x - a.width >= LABEL_PX:
                yield {"x": (a.x + a.width + b.x) / 2, "y": a.middle[1], "text": text}
            continue
        y = b.y - 10 - 15 * above[lower]
        above[lower] += 1
        share = (y - a.middle[1]) / (b.middle[1] - a.middle[1])
        yield {"x": a.middle[0] + share * (b.middle[0] - a.middle[0]), "y": y, "text": text}


def _layers(
    places: Mapping[str, _Box],
    texts: Mapping[str, list[str]],
    lines: list[dict[str, float]],
    labels: list[dict[str, float | str]],
) -> Iterator[Spec]:
    halo: Spec = {"stroke": PAPER, "strokeWidth": 6, "strokeJoin": "round"}
    ends = {"x2": "x2", "y2": "y2"}
    yield _given(lines, layer("rule", ends, color=MUTED, strokeWidth=1.2))
    for style in (halo, {"stroke": None}):
        yield _given(labels, layer("text", {"text": "text"}, color=MUTED, **style))
    boxes = [
        {"x": x, "y": y, "x2": x + width, "y2": y + height}
        for x, y, width, height in places.values()
    ]
    frame: Spec = {"fill": SHADE, "stroke": MUTED, "cornerRadius": 4}
    yield _given(boxes, layer("rect", ends, **frame))
    for head in (True, False):
        rows = [
            {"x": places[node].middle[0], "y": places[node].y + 14 + LINE_PX * line, "text": text}
            for node, some in texts.items()
            for line, text in enumerate(some)
            if (line == 0) == head
        ]
        room = min(place.width for place in places.values()) - 10
        weight: Spec = {"color": INK, "fontWeight": 600} if head else {"color": MUTED}
        yield _given(rows, layer("text", {"text": "text"}, limit=room, **weight))


def _given(rows: list[Any], drawn: Spec) -> Spec:
    return {"data": {"values": rows}, **drawn}


def _tasks(problem: Problem, node: str) -> list[str]:
    """Return the names of the tasks that a node can run, anchored tasks in parentheses."""
    tasks = problem.pipeline.tasks.values()
    return [f"({one.name})" if one.anchored else one.name for one in tasks if node in one.on]


def _link(link: Link) -> str:
    replayed = isinstance(link.delay_ms, Trace)
    delay = "as recorded" if replayed else write_ms(link.delay_ms.expectation)
    rate = "" if math.isinf(link.rate_mbps) else f", {write_number(link.rate_mbps, 0)} Mbit/s"
    return f"{delay}{rate}"
