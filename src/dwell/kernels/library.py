"""Loading of the compiled kernel, a library of C functions.

Calls release Python's global lock (`ctypes.CDLL`). Two threads may call at the same time, because
the library has no global state. The build hook (`hatch_build.py`) makes the file.
"""

from __future__ import annotations

import ctypes
import platform
import shlex
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, Final

from dwell.errors import DISTRIBUTION, KernelError
from dwell.kernels.library_file import FLAGS, NAME, is_of, read_header, source_digest

#: Command that builds the library in a checkout.
BUILD: Final = "apt-get install g++ && make env"
#: Command that repairs an installed package.
INSTALL_AGAIN: Final = f"pip install --force-reinstall {DISTRIBUTION}"


@cache
def library() -> ctypes.CDLL:
    """Return the library of this package.

    Raises KernelError if it is missing, damaged, for another processor, or from other sources than
    those beside it.
    """
    return load(files(__package__))


def foreign(name: str, result: Any, *arguments: Any) -> Callable[[], Any]:
    """Declare a function of the library by the types of its result and its arguments.

    The result is a callable that returns the function. Its first call loads the library and may
    raise the errors of `library`.
    """

    @cache
    def loaded() -> Any:
        function = getattr(library(), name)
        function.restype, function.argtypes = result, arguments
        return function

    return loaded


def digest() -> str:
    """Return the SHA-256 of the sources of the library."""
    return str(foreign("dwell_digest", ctypes.c_char_p)()(), "ascii")


def compiler() -> str:
    """Return the name and version of the compiler that built the library."""
    return str(foreign("dwell_compiler", ctypes.c_char_p)()(), "utf-8")


def load(folder: Traversable) -> ctypes.CDLL:
    """Check the library in a folder against the sources there, if any, and open it.

    The check precedes the mapping into memory, because access to a missing part of a mapped file
    ends the process.
    """
    file = folder.joinpath(NAME)
    remedy = f"rm {shlex.quote(str(file))} && make env"
    try:
        content = file.read_bytes()
        flaw = _flaw(content, folder)
        if not flaw:
            return ctypes.CDLL(str(file))
    except FileNotFoundError:
        flaw, remedy = "is missing", BUILD
    except OSError as error:
        flaw = f"cannot be opened: {error.strerror or error}"
    if not folder.joinpath("../../../hatch_build.py").is_file():
        remedy = INSTALL_AGAIN
    raise KernelError(f"the compiled kernel {file} {flaw}", remedy)


def _flaw(content: bytes, folder: Traversable) -> str:
    """Return the fault of a library in a folder as text; empty if it is valid."""
    header, machine = read_header(content), platform.machine()
    if header is None:
        return "is no library"
    if header.machine != machine:
        return f"is for {header.machine}, this computer is {machine}"
    if len(content) < header.n_bytes:
        return f"is cut short: {len(content)} of {header.n_bytes} bytes"
    # A wheel has no sources.
    if folder.joinpath(FLAGS).is_file() and not is_of(content, source_digest(folder)):
        return "was built of other sources than those beside it"
    return ""
