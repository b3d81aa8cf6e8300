"""The tables of keys, from the forms of the files: `python docs/cell_tables.py` writes them.

A table stands between ``<!-- keys of NAME -->`` and the next empty line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from dwell.cellfile import cell_form, fleet_file, study_form
from dwell.cellfile.forms import (
    ChoiceForm,
    FlagForm,
    Form,
    FormKey,
    ListForm,
    MappingForm,
    NumberForm,
    Shape,
    TextForm,
    WrittenForm,
)
from dwell.model.declaration import KeyTier
from dwell_lab.testbed import inventory

FOLDER = Path(__file__).parent / "reference"
FILES = tuple(FOLDER / name for name in ("cells.md", "files.md"))
#: Shapes of the tables. The second of two is a shape whose keys the table leaves out.
SHAPES: Mapping[str, Shape | tuple[Shape, Shape]] = {
    "the file": cell_form.CELL.shape,
    "a trace": cell_form.TRACE,
    "a node": cell_form.NODE,
    "a quota": cell_form.QUOTA,
    "a link": cell_form.LINK,
    "a task": cell_form.TASK,
    "an execution": cell_form.EXECUTION,
    "a flow": cell_form.FLOW,
    "a chain": cell_form.CHAIN,
    "a search": cell_form.EVERY_PLACEMENT,
    "replicas": cell_form.REPLICATED,
    "a disturbance": cell_form.DISTURBANCE,
    "the objective": cell_form.OBJECTIVE,
    "weights": cell_form.WEIGHTS,
    "targets": cell_form.TARGETS,
    "caps": cell_form.CAPS,
    "misses": cell_form.MISSES,
    "the controller": cell_form.CONTROLLER,
    "replicate": cell_form.REPLICATE,
    "the servo": cell_form.SERVO,
    "its target": cell_form.TARGET,
    "a ROS 2 topic": cell_form.ROS_TOPIC,
    "live": cell_form.LIVE,
    "ROS 2 commands": (cell_form.ROS_COMMANDS, cell_form.ROS_TOPIC),
    "a host": cell_form.HOST,
    "a fleet": fleet_file.FLEET.shape,
    "an entry": fleet_file.ENTRY,
    "a study": study_form.STUDY.shape,
    "a study of a fleet": (study_form.FLEET_STUDY.shape, study_form.STUDY.shape),
    "an inventory": inventory.INVENTORY.shape,
    "a real host": inventory.HOST,
    "link commands": inventory.LINK,
}
HEAD = "| key | value | default | meaning |", "|---|---|---|---|"
#: Marks around the keys of a tier.
MARKS: Mapping[KeyTier, str] = {"first": "**", "tuning": "", "measured": "*"}
PLACE = re.compile(r"<!-- keys of ([^\n]*) -->\n(?:\|[^\n]*\n)*")


def with_tables(text: str) -> str:
    """Return the page with every table as the forms have it."""
    return PLACE.sub(lambda found: f"{found[0].splitlines()[0]}\n{_table(found[1])}", text)


def _table(name: str) -> str:
    shape = SHAPES[name]
    full, base = shape if isinstance(shape, tuple) else (shape, None)
    known = set() if base is None else {_row(key) for key in base.keys}
    rows = (row for row in map(_row, full.by_tier) if row not in known)
    return "".join(f"{line}\n" for line in (*HEAD, *rows))


def _row(key: FormKey) -> str:
    mark = MARKS[key.tier]
    return f"| {mark}`{key.named}`{mark} | {_value(key)} | {_usual(key)} | {key.says} |"


def words(form: Form) -> str:
    """Return the values that a form allows."""
    match form:
        case NumberForm(bound):
            return str(bound).removeprefix("a ")
        case TextForm(bound, known):
            text = "text" if bound is None else str(bound).removeprefix("a ")
            return ", ".join([*(f"`{name}`" for name in known), text])
        case FlagForm():
            return "`true`, `false`"
        case ChoiceForm(choices):
            return ", ".join(f"`{choice}`" for choice in choices)
        case WrittenForm(ways):
            return ways
        case MappingForm(inner):
            return f"name → {words(inner)}"
        case ListForm(inner):
            return f"list of {words(inner)}"
        case Shape():
            return f"`{{{', '.join(form.names)}}}`"
        case cell_form.WordsForm(means, shape):
            return ", ".join([*(f"`{word}`" for word in means), words(shape)])
        case cell_form.CandidateForm():
            return "task → node, `{replicas, after_ms}`"
        case cell_form.ActuatorForm():
            return "text, `{ros2}`"
        case cell_form.CandidatesForm():
            return "name → names, or `all`"
        case cell_form.ProcessForm():
            return "process"
        case fleet_file.PhasesForm():
            return "`sync`, `even`, `random`, list of ms"
    raise TypeError(f"no words for {form!r}")


def _value(key: FormKey) -> str:
    form, shown = key.form, words(key.form)
    if len(shown) <= 60 or not isinstance(form, MappingForm | ListForm | Shape):
        return shown
    if isinstance(form, Shape):
        return "keys"
    return "names" if isinstance(form, MappingForm) else "list"


def _usual(key: FormKey) -> str:
    if key.is_required:
        return ""
    return key.usual or "none"


if __name__ == "__main__":
    for page in FILES:
        page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
