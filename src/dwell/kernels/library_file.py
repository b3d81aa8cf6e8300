"""The file of the compiled kernel: its name, the sources that it is of, and whether it is whole.

The build hook (`hatch_build.py`) runs this module before anything is installed, so that it imports
the standard library alone.
"""

from __future__ import annotations

import hashlib
import struct
from importlib.resources.abc import Traversable
from typing import Final, NamedTuple

NAME: Final = "libdwell_kernel.so"
#: Options of the compiler, one a line; clang-tidy and editors read the same file.
FLAGS: Final = "compile_flags.txt"

#: Machines by their number in the header of an ELF file, with the name that `uname -m` has.
MACHINES: Final = {62: "x86_64", 183: "aarch64"}
#: The header of an ELF file of 64 bits: magic number, machine, where its table of sections begins,
#: and the size and number of the table's entries.
_HEADER: Final = struct.Struct("<4s14xH20xQ10xHH2x")


def source_digest(folder: Traversable) -> str:
    """Return the SHA-256 of the C++ sources in a folder, and of the flags they are compiled by."""
    digest = hashlib.sha256()
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.name.endswith((".cpp", ".h")) or entry.name == FLAGS:
            content = entry.read_bytes()
            digest.update(f"{entry.name} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


class LibraryHeader(NamedTuple):
    """What the header of a library tells.

    Parameters
    ----------
    machine : str
        The processor it is for, as ``x86_64``.
    n_bytes : int
        What the file has at least where it is whole: the table of sections is its end.
    """

    machine: str
    n_bytes: int


def read_header(content: bytes) -> LibraryHeader | None:
    """Return what the header tells; None where the content does not begin as a library does."""
    if len(content) < _HEADER.size:
        return None
    magic, machine, sections, entry_bytes, entries = _HEADER.unpack_from(content)
    if magic != b"\x7fELF":
        return None
    name = MACHINES.get(machine, f"processor {machine}")
    return LibraryHeader(name, sections + entry_bytes * entries)


def is_of(content: bytes, *texts: str) -> bool:
    """Return whether a whole library has some texts, each of them to its end."""
    header = read_header(content)
    whole = header is not None and len(content) >= header.n_bytes
    return whole and all(text.encode() + b"\0" in content for text in texts)
