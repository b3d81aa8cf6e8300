"""A user's own classes and functions, named ``package.module:name``, from a folder or installed."""

from __future__ import annotations

import difflib
import hashlib
import importlib
import inspect
import pkgutil
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from dwell.errors import DwellError, KernelError, SimulationError, UserNote, describe_raised

if TYPE_CHECKING:
    from dwell.model.problem import Problem

#: Prefix of the modules of this package.
OURS = f"{__name__.partition('.')[0]}."
#: Modules from folders of cell files, by folder and name.
_beside: dict[tuple[str, str], ModuleType] = {}
_importing = threading.RLock()
#: Digests of sources at their first use.
_digests: dict[ModuleType, str] = {}


def make_user_class(
    name: str, problem: Problem, method: str, what: str, error: type[DwellError]
) -> Any:
    """Make an object of a user's class, by ``from_problem(problem)`` if defined.

    `name` is ``package.module:Class``. Modules in the problem's `folder` take precedence over
    installed modules. `what` is the kind of class for messages, as ``policy``. Raises an `error` if
    the module or class does not exist, the import raises, the class requires arguments or raises,
    or its object lacks the `method`.
    """
    who, attribute = f"{what} {name!r}", name.partition(":")[2]
    kind = user_class(name, problem.folder, what, error)
    if not callable(getattr(kind, method, None)):
        raise error(f"{who}: the class is no {what}: it has no method {method}")
    from_problem = getattr(kind, "from_problem", None)
    if from_problem is None:
        wanted = _arguments(kind)
        if wanted:
            raise error(
                f"{who}: the class wants arguments ({', '.join(wanted)}); give them defaults, or "
                "the class a classmethod from_problem(problem)"
            )
    try:
        return kind() if from_problem is None else from_problem(problem)
    except DwellError:
        raise
    except Exception as fault:
        call = f"{attribute}()" if from_problem is None else f"{attribute}.from_problem(problem)"
        raise error(f"{who}: {call} failed: {describe_raised(fault, users=True)}") from fault


def user_class(name: str, folder: str | None, what: str, error: type[DwellError]) -> type:
    """Return a user's class; arguments as in `make_user_class`.

    Raises an `error` if the module or class does not exist, or the import raises.
    """
    who = f"{what} {name!r}"
    kind = _named(name, folder, "class", who, error)
    if not isinstance(kind, type):
        module_name, _, attribute = name.partition(":")
        raise error(f"{who}: {attribute!r} in {module_name} is no class")
    return kind


class UserCall(NamedTuple):
    """A call of a method that a user may have written; its errors get a `UserNote`."""

    given: object
    method: str
    #: The window of the call, if any.
    window: int | None = None

    def __enter__(self) -> None:
        """Begin the call."""

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """End it; an error passes."""
        if not isinstance(error, Exception) or isinstance(error, KernelError):
            return
        kind = type(self.given)
        if not kind.__module__.startswith(OURS):
            when = "" if self.window is None else f" at window {self.window}"
            raised = describe_raised(error, users=True)
            error.add_note(UserNote(f"{kind.__name__}: {self.method}{when} failed: {raised}"))


def user_function(
    name: str, folder: str | None, what: str, error: type[DwellError]
) -> Callable[..., object]:
    """Return a user's function.

    `name` is ``package.module:function``, and `what` the kind of function for messages, as
    ``metric``. Modules in `folder` take precedence over installed modules. Raises an `error` if the
    module or function does not exist, or the import raises.
    """
    who = f"{what} {name!r}"
    function = _named(name, folder, "function", who, error)
    if not callable(function):
        module_name, _, attribute = name.partition(":")
        raise error(f"{who}: {attribute!r} in {module_name} is not a function")
    return cast("Callable[..., object]", function)


def _named(name: str, folder: str | None, kind: str, who: str, error: type[DwellError]) -> object:
    """Return the class or function that ``package.module:name`` names."""
    module_name, _, attribute = name.partition(":")
    module = import_user_module(module_name, folder, who, error)
    found: object = getattr(module, attribute, None)
    if found is None:
        near = difflib.get_close_matches(attribute, dir(module), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise error(f"{who}: {module_name} has no {kind} {attribute!r}{hint}")
    return found


def source_digest(name: str, folder: str | None) -> str | None:
    """Return a digest of the source of the module that ``package.module:Class`` names.

    Returns None if the module cannot be imported or has no source. Raises SimulationError if the
    source has changed since this process imported it.
    """
    try:
        module = import_user_module(name.partition(":")[0], folder, name, DwellError)
    except DwellError:
        return None
    return _digest(module)


def object_digest(given: object) -> str | None:
    """Return a digest of the source of the module of an object's class, or None."""
    module = sys.modules.get(type(given).__module__)
    return None if module is None else _digest(module)


def _digest(module: ModuleType) -> str | None:
    """Return a digest of a module's source, which must not have changed since its import."""
    try:
        source = inspect.getsource(module)
    except (OSError, TypeError):
        return None
    digest = hashlib.sha256(source.encode()).hexdigest()[:16]
    if _digests.setdefault(module, digest) != digest:
        raise SimulationError(
            f"{module.__name__}: its source has changed since this process imported it; start a "
            "new process (in a notebook, restart the kernel)"
        )
    return digest


def _arguments(kind: type) -> list[str]:
    """Return the names of the required arguments of a class."""
    try:
        parameters = inspect.signature(kind).parameters.values()
    except (TypeError, ValueError):  # a class in C may have no signature
        return []
    optional = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [one.name for one in parameters if one.default is one.empty and one.kind not in optional]


def import_user_module(
    name: str, folder: str | None, who: str, error: type[DwellError]
) -> ModuleType:
    """Import a module from a folder, or else an installed module."""
    beside = folder is not None and name.partition(".")[0] in _modules_in(folder)
    try:
        if folder is not None and beside:
            return _import_beside(name, folder)
        return _import_installed(name)
    except (Exception, SystemExit) as fault:
        missing = fault.name if isinstance(fault, ModuleNotFoundError) else None
        if missing is not None and f"{name}.".startswith(f"{missing}."):
            place = "" if folder is None else f"neither in {folder} nor "
            raise error(f"{who}: no module {missing!r}, {place}installed") from None
        raise error(f"{who}: importing {name} failed: {describe_raised(fault)}") from fault


def _import_beside(name: str, folder: str) -> ModuleType:
    """Import a module from a folder, separately from equal names in other folders."""
    with _importing:
        if (folder, name) not in _beside:
            with _first_on_path(folder):
                _beside[folder, name] = importlib.import_module(name)
        return _beside[folder, name]


def _import_installed(name: str) -> ModuleType:
    """Import an installed module, ignoring equal names in folders of cell files."""
    package = name.partition(".")[0]
    with _importing:
        beside = {
            known: module
            for known, module in sys.modules.items()
            if known.partition(".")[0] == package
            and any(_is_in(module, folder) for folder, _ in _beside)
        }
        with _hidden(beside):
            return importlib.import_module(name)


@contextmanager
def _first_on_path(folder: str) -> Iterator[None]:
    """Search a folder first for modules; restore modules with equal names afterwards."""
    names = _modules_in(folder)
    elsewhere = {
        name: module
        for name, module in sys.modules.items()
        if name.partition(".")[0] in names and not _is_in(module, folder)
    }
    with _hidden(elsewhere), importable_from(folder):
        yield


@contextmanager
def importable_from(folder: str) -> Iterator[None]:
    """Search a folder first for modules, as ``python -m`` does with the current folder."""
    sys.path.insert(0, folder)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        if folder in sys.path:
            sys.path.remove(folder)


@contextmanager
def _hidden(modules: Mapping[str, ModuleType]) -> Iterator[None]:
    """Hide imported modules within the block."""
    for name in modules:
        del sys.modules[name]
    try:
        yield
    finally:
        sys.modules.update(modules)


def _modules_in(folder: str) -> set[str]:
    """Return the names of the modules and packages in a folder, except Dwell's own."""
    return {one.name for one in pkgutil.iter_modules([folder])} - {"dwell", "__main__"}


def _is_in(module: ModuleType, folder: str) -> bool:
    # A package without __init__.py has paths instead of a file.
    places = [getattr(module, "__file__", None), *getattr(module, "__path__", ())]
    return any(isinstance(one, str) and one.startswith(f"{folder}/") for one in places)
