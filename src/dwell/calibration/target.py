"""Target of a measurement: the callable of a name such as ``package.module:function``."""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path

from dwell.errors import ProfileError, describe_raised


def find_callable(name: str, option: str) -> Callable[..., object]:
    """Import a callable by name.

    Parameters
    ----------
    name : str
        ``package.module:function`` or ``package.module:object.method``, to any depth.
    option : str
        Option of the command, for messages: ``--task perception``.

    Raises
    ------
    ProfileError
        If the module or attribute is missing, the import fails, or the object is not a callable
        that runs when called (classes, coroutines and generators are refused).
    """
    module_name, colon, path = name.partition(":")
    if not colon or not all(part.isidentifier() for part in f"{module_name}.{path}".split(".")):
        raise ProfileError(f"{option}: {name!r} is not of the form package.module:function")
    found = _import(module_name, name, option)
    for depth, part in enumerate(path.split(".")):
        if not hasattr(found, part):
            owner = ".".join([module_name, *path.split(".")[:depth]])
            near = difflib.get_close_matches(part, dir(found), n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ProfileError(f"{option}: {owner} has no {part!r}{hint}")
        found = getattr(found, part)
    return _callable(found, name, option)


def _import(module_name: str, name: str, option: str) -> object:
    try:
        return importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and _is_part(error.name, module_name):
            raise ProfileError(
                f"{option}: no module {error.name!r} (from {name!r}), neither in "
                f"{Path.cwd()} nor among the installed ones"
            ) from None
        raise ProfileError(
            f"{option}: importing {module_name!r} failed: {describe_raised(error)}"
        ) from None


def _is_part(missing: str | None, module_name: str) -> bool:
    """Whether the missing module is `module_name` or a package around it."""
    return missing is not None and f"{module_name}.".startswith(f"{missing}.")


def _callable(found: object, name: str, option: str) -> Callable[..., object]:
    if isinstance(found, type) or not callable(found):
        what = "a class" if isinstance(found, type) else f"of type {type(found).__name__}"
        methods = "method" if not callable(getattr(found, "process", None)) else "process"
        raise ProfileError(
            f"{option}: {name!r} is {what}, not a function; make an object in the module and name "
            f"its method, as module:object.{methods}"
        )
    for one in (found, getattr(found, "__call__", None)):  # noqa: B004
        if inspect.iscoroutinefunction(one) or inspect.isasyncgenfunction(one):
            raise ProfileError(
                f"{option}: {name!r} is async, so that calling it runs nothing; name a function "
                "that runs it to its end (asyncio.run)"
            )
        if inspect.isgeneratorfunction(one):
            raise ProfileError(
                f"{option}: {name!r} is a generator, so that calling it runs nothing; name a "
                "function that goes through it"
            )
    return found
