"""The file of the compiled kernel: its name, the digest of its sources, and its completeness.

The build hook (`hatch_build.py`) runs this module before any package is installed. The module
therefore imports only the standard library.
"""

from __future__ import annotations

import hashlib
import struct
from importlib.resources.abc import Traversable
from typing import Final, NamedTuple

NAME: Final = "libdwell_kernel.so"
#: Options of the compiler, one per line; clang-tidy and editors read the same file.
FLAGS: Final = "compile_flags.txt"

#: Names of machines as in `uname -m`, by their number in the header of an ELF file.
MACHINES: Final = {62: "x86_64", 183: "aarch64"}
#: The header of a 64-bit ELF file: magic number, machine, offset of the table of sections, and the
#: size and number of the table's entries.
_HEADER: Final = struct.Struct("<4s14xH20xQ10xHH2x")


def source_digest(folder: Traversable) -> str:
    """Return the SHA-256 of the C++ sources in a folder, and of the compiler's options."""
    digest = hashlib.sha256()
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.name.endswith((".cpp", ".h")) or entry.name == FLAGS:
            content = entry.read_bytes()
            digest.update(f"{entry.name} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


class LibraryHeader(NamedTuple):
    """Contents of a library's header.

    Parameters
    ----------
    machine : str
        Processor of the library, such as ``x86_64``.
    n_bytes : int
        Least size of the complete file, which ends with the table of sections.
    """

    machine: str
    n_bytes: int


def read_header(content: bytes) -> LibraryHeader | None:
    """Return the header, or None if the content is no ELF file."""
    if len(content) < _HEADER.size:
        return None
    magic, machine, sections, entry_bytes, entries = _HEADER.unpack_from(content)
    if magic != b"\x7fELF":
        return None
    name = MACHINES.get(machine, f"processor {machine}")
    return LibraryHeader(name, sections + entry_bytes * entries)


def is_of(content: bytes, *texts: str) -> bool:
    """Return whether a library is complete and contains all texts as null-terminated strings."""
    header = read_header(content)
    whole = header is not None and len(content) >= header.n_bytes
    return whole and all(text.encode() + b"\0" in content for text in texts)
