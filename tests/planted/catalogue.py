"""The catalogue of planted faults: `faults.yaml`, read and checked."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import yaml

ROOT = Path(__file__).parents[2]
FILE = Path(__file__).with_name("faults.yaml")

#: A heading, or words in bold at the beginning of a paragraph or an item of a list.
HEADING = re.compile(r"(?:#{1,3} (?P<heading>.+)|(?:\d+\. |[*-] )?\*\*(?P<bold>.+?)\*\*)")


class Fault(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fault that could be made in a rearrangement, and the tests that find it.

    Parameters
    ----------
    fault : str
        Name.
    promise : str
        Words of a page that are true no more where it is planted.
    file : str
        Path of the source.
    text, planted : str
        What stands once in the file, and what is planted in its place.
    tests : list of str
        Paths of files, or ids of single tests.
    """

    fault: str
    promise: str
    file: str
    text: str
    planted: str
    tests: list[str]

    @property
    def path(self) -> Path:
        """The file below the root of the tree."""
        return Path(self.file)

    @property
    def is_compiled(self) -> bool:
        """Whether the kernel has to be built with it."""
        return self.path.suffix in (".h", ".cpp")

    def flaw(self, root: Path = ROOT) -> str:
        """Return why it cannot be planted in a tree; empty where it can."""
        file = root / self.path
        if not file.is_file():
            return f"{self.path} does not exist"
        count = file.read_text(encoding="utf-8").count(self.text)
        if self.text == self.planted:
            return "it changes nothing"
        return "" if count == 1 else f"its text stands {count} times in {self.path}"


def catalogue() -> dict[str, list[Fault]]:
    """Return the planted faults by the page whose promise they break."""
    content = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    return msgspec.convert(content, dict[str, list[Fault]])


def folded(text: str) -> str:
    """Return a text with its white space made single spaces."""
    return " ".join(text.split())


def sections(page: str) -> dict[str, str]:
    """Return the sections of a page, folded, by their heading or the bold words they begin with."""
    parts: dict[str, list[str]] = {}
    name = ""
    for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
        if found := HEADING.match(line):
            name = folded(found["heading"] or found["bold"])
        parts.setdefault(name, []).append(line)
    return {name: folded("\n".join(lines)) for name, lines in parts.items()}


def section_of(fault: Fault, page: str) -> str:
    """Return the section of a page that a fault's promise stands in; empty for none."""
    promise = folded(fault.promise)
    return next((name for name, text in sections(page).items() if promise in text), "")
