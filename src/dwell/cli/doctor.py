"""`dwell doctor`: parts of Dwell on this computer, and the command for each missing part."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from pathlib import Path

import typer

import dwell
from dwell.cli.findings import Finding, Part, optional, print_findings
from dwell.cli.output import print_json
from dwell.errors import DISTRIBUTION, OPTIONAL, KernelError, installing
from dwell.kernels import library
from dwell.kernels.library_file import NAME
from dwell.model import Problem
from dwell.model.entry_points import CHECKS, added

#: What each extra is for.
EXTRAS = {
    "sim": "dwell run, study, demo, validate",
    "report": "dwell report",
    "live": "dwell live, agent, controller, keys",
    "mcap": "dwell report --mcap, dwell dash --mcap",
    "dask": "dwell study --dask",
    "dash": "dwell dash",
}


def consult(problem: Problem | None, *, keys: Path | None, as_json: bool) -> bool:
    """Look at everything and print it.

    Parameters
    ----------
    keys : Path or None
        A keyring, or a folder of keyrings.

    Returns
    -------
    bool
        Whether all needed things are well.
    """
    extras = [_extra(name) for name in EXTRAS]
    kernel = _kernel()
    others = [part for checks in added(CHECKS).values() for part in checks(problem, keys)]
    parts = {
        "extras": extras,
        "kernel": [kernel],
        **{part.name: part.findings for part in others},
        "runs here": list(_runs(extras, kernel, others)),
    }
    well = all(row.ok or not row.needed for rows in parts.values() for row in rows)
    if as_json:
        findings = [{"part": part, **asdict(row)} for part, rows in parts.items() for row in rows]
        print_json({"ok": well, "version": dwell.__version__, "findings": findings})
        return well
    system = f"{platform.system()} {platform.release()} ({platform.machine()})"
    typer.echo(f"dwell {dwell.__version__}, Python {platform.python_version()}, {system}")
    for part, rows in parts.items():
        typer.echo(f"\n{part}")
        print_findings(rows, broken="BROKEN", lacking="note")
    return well


# ------------------------------------------------------------------------- extras and kernel


@cache
def _modules() -> dict[str, str]:
    """Return the module of each installed optional package, by package."""
    packages = packages_distributions()
    return {package: module for module in OPTIONAL for package in packages.get(module, ())}


def _extra(name: str) -> Finding:
    """Import the packages of an extra; an installed package may still fail."""
    try:
        lines = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        found = f"{DISTRIBUTION} itself is not installed; only its sources were found"
        return optional(name, False, found, installing(name))
    modules = _modules()
    wanted = [
        re.split(r"[^\w.-]", line)[0]
        for line in lines
        if re.search(rf"extra == ['\"]{name}['\"]", line)
    ]
    missing, failed, there = [], [], []
    for package in wanted:
        try:
            there.append(f"{package} {version(package)}")
            if package in modules:
                import_module(modules[package])
        except PackageNotFoundError:
            missing.append(package)
        except Exception as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            failed.append(f"{package} cannot be imported: {reason}")
    if failed:
        again = installing(name).replace("install", "install --force-reinstall")
        return Finding(name, False, "; ".join(failed), again)
    if missing:
        found = f"not installed: {', '.join(missing)}"
        return optional(name, False, found, installing(name))
    return Finding(name, True, ", ".join(there))


def _kernel() -> Finding:
    """Load the compiled kernel. It is optional, but a damaged file is a fault."""
    name = "compiled kernel"
    try:
        found = f"of the sources {library.digest()[:12]}, by {library.compiler()}"
    except KernelError as error:
        there = Path(library.__file__).with_name(NAME).is_file()
        return Finding(name, False, error.flaw, error.remedy, needed=there)
    return Finding(name, True, found)


# ------------------------------------------------------------------------- what runs here


def _runs(extras: Sequence[Finding], kernel: Finding, others: Sequence[Part]) -> Iterator[Finding]:
    """Yield a finding per group of commands: whether it works here, else the missing parts."""
    named = {extra.name: replace(extra, name=f"the extra {extra.name}") for extra in extras}
    needs = {
        **{EXTRAS[name]: [extra] for name, extra in named.items()},
        EXTRAS["sim"]: [named["sim"], kernel],
        **{part.command: [named[part.extra], *part.required] for part in others if part.command},
    }
    for commands, needed in needs.items():
        lacking = [need for need in needed if not need.ok]
        remedies = dict.fromkeys(need.remedy for need in lacking if need.remedy)
        names = ", ".join(need.name for need in lacking)
        found = f"not without {names}" if lacking else "yes"
        yield optional(commands, not lacking, found, "; ".join(remedies))
