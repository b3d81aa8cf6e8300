"""The compiled kernel, a library of C functions: found beside its sources, checked, and opened.

Python's lock is not held during a call (`ctypes.CDLL`); two threads may call at once, since the
library has no state of its own. The build hook (`hatch_build.py`) makes the file.
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
from dwell.kernels.library_file import NAME, is_of, read_header, source_digest

#: The line that builds the library in a checkout.
BUILD: Final = "apt-get install g++ && make env"
#: The line that mends an installed package.
INSTALL_AGAIN: Final = f"pip install --force-reinstall {DISTRIBUTION}"


@cache
def library() -> ctypes.CDLL:
    """Return the library that was built of the sources beside this module.

    Raises
    ------
    KernelError
        If it is missing, damaged, of other sources or for another processor.
    """
    return load(files(__package__))


def foreign(name: str, result: Any, *arguments: Any) -> Callable[[], Any]:
    """Declare a function of the library, by the types of its result and of its arguments.

    Returns
    -------
    callable
        Returns the function; the first call loads the library, and raises what `library` does.
    """

    @cache
    def loaded() -> Any:
        function = getattr(library(), name)
        function.restype, function.argtypes = result, arguments
        return function

    return loaded


def digest() -> str:
    """Return the SHA-256 of the sources that the library was built of."""
    return str(foreign("dwell_digest", ctypes.c_char_p)()(), "ascii")


def compiler() -> str:
    """Return the name and version of the compiler that built the library."""
    return str(foreign("dwell_compiler", ctypes.c_char_p)()(), "utf-8")


def load(folder: Traversable) -> ctypes.CDLL:
    """Check the library in a folder against the sources there, and open it.

    It is checked before it is mapped into memory, where reading a part that the file does not have
    would end the process.
    """
    file = folder.joinpath(NAME)
    remedy = f"rm {shlex.quote(str(file))} && make env"
    try:
        content = file.read_bytes()
        flaw = _flaw(content, source_digest(folder))
        if not flaw:
            return ctypes.CDLL(str(file))
    except FileNotFoundError:
        flaw, remedy = "is missing", BUILD
    except OSError as error:
        flaw = f"cannot be opened: {error.strerror or error}"
    if not folder.joinpath("../../../hatch_build.py").is_file():
        remedy = INSTALL_AGAIN
    raise KernelError(f"the compiled kernel {file} {flaw}", remedy)


def _flaw(content: bytes, digest: str) -> str:
    """Return what is wrong with a library; empty where nothing is."""
    header, machine = read_header(content), platform.machine()
    if header is None:
        return "is no library"
    if header.machine != machine:
        return f"is for {header.machine}, this computer is {machine}"
    if len(content) < header.n_bytes:
        return f"is cut short: {len(content)} of {header.n_bytes} bytes"
    if not is_of(content, digest):
        return "was built of other sources than those beside it"
    return ""
