"""`dwell keys`: certificates of the members of a live cell."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dwell.cli.options import Json, argument, option
from dwell.cli.output import aligned, print_json

if TYPE_CHECKING:
    from dwell.live.trust.roster import Roster, Subject
    from dwell.model import Problem

Folder = Annotated[Path, argument("FOLDER", "Folder of the authority.")]
Name = Annotated[str, argument("NAME", "Node of the cell, or another subject.")]
SubjectRole = Annotated[
    str | None,
    option("ROLE", "node, controller, operator or observer.", default="the subject's last"),
]
Addresses = Annotated[list[str] | None, option("HOST", "Address of the subject; may be repeated.")]
Days = Annotated[int, option("N", "Days until certificates expire.")]

keys = typer.Typer(
    no_args_is_help=True,
    help="Issue and revoke the certificates of a live cell.",
)


@keys.command()
def init(
    cell: Annotated[Path, argument("CELL", "Cell file.")],
    out: Annotated[Path, option("FOLDER", "Folder for the authority and all keyrings.")],
    days: Days = 365,
    as_json: Json = False,
) -> None:
    """Make the authority of a cell, and its first keyrings."""
    import dwell
    from dwell.live.trust.authority import Authority

    problem = dwell.load(cell)
    authority = Authority.create(out, problem.name, days=days)
    for node in problem.fabric.nodes:
        authority.issue(node, "node", _addresses(problem, node), days=days)
    on = _addresses(problem, problem.controller_node)
    authority.issue("controller", "controller", on, days=days)
    authority.issue("operator", "operator", days=days)
    _show(authority.roster, as_json=as_json)
    if not as_json:
        typer.echo(
            f"\nKeep {out}/ca here: it can issue any certificate.\n"
            "Copy each other folder to its host only, and name it there with --keys."
        )


def _addresses(problem: Problem, node: str) -> list[str]:
    """Return all addresses of a node, as other nodes see them."""
    from dwell.model import Host

    host = problem.live.hosts.get(node) or Host()
    return [host.address, *(seen.address for seen in host.seen_from.values())]


@keys.command()
def issue(
    folder: Folder,
    name: Name,
    role: SubjectRole = None,
    address: Addresses = None,
    days: Days = 365,
    as_json: Json = False,
) -> None:
    """Issue a certificate with a new key; older ones stay valid."""
    from dwell.live.trust.authority import Authority

    authority = Authority.open(folder)
    authority.issue(name, role, address, days=days)
    _show_changed(authority.roster, as_json=as_json)


@keys.command()
def request(
    node: Annotated[
        list[str], argument("NODE", "Node of the cell, or another subject; may be repeated.")
    ],
    out: Annotated[Path, option("FOLDER", "Folder for keyrings and requests.")] = Path("keys"),
) -> None:
    """Make a key on this computer, and a request for it."""
    from dwell.live.trust.request import request_certificate

    made = [request_certificate(out, name) for name in node]
    names = " ".join(path.name for path in made)
    typer.echo(
        f"{' '.join(map(str, made))}\n\nTake the requests to the folder of the authority: "
        f"dwell keys sign {names}\nTake cert.pem, ca.pem and roster.json from there back into "
        f"{', '.join(str(out / name) for name in node)}."
    )


@keys.command()
def sign(
    request: Annotated[
        list[Path], argument("REQUEST", "File from `dwell keys request`; may be repeated.")
    ],
    authority: Annotated[Path, option("FOLDER", "Folder of the authority.")] = Path("keys"),
    role: SubjectRole = None,
    address: Addresses = None,
    days: Days = 365,
    as_json: Json = False,
) -> None:
    """Issue the certificates of requests."""
    from dwell.live.trust.authority import Authority

    opened = Authority.open(authority)
    for path in request:
        opened.sign(path, role, address, days=days)
    _show_changed(opened.roster, as_json=as_json)


@keys.command()
def revoke(folder: Folder, name: Name, as_json: Json = False) -> None:
    """Revoke the certificates of a subject."""
    from dwell.live.trust.authority import Authority

    authority = Authority.open(folder)
    authority.revoke(name)
    _show_changed(authority.roster, as_json=as_json)


@keys.command()
def show(
    folder: Annotated[Path, argument("FOLDER", "Folder of an authority, or a keyring.")],
    as_json: Json = False,
) -> None:
    """List the subjects, their roles and expiry dates."""
    from dwell.live.trust.authority import AUTHORITY, Authority
    from dwell.live.trust.keyring import Keyring

    if (folder / AUTHORITY).is_dir():
        _show(Authority.open(folder).roster, as_json=as_json)
        return
    keyring = Keyring.open(folder)
    _show(keyring.roster, own=keyring.own, as_json=as_json)


def _show_changed(roster: Roster, *, as_json: bool) -> None:
    _show(roster, as_json=as_json)
    if not as_json:
        typer.echo(
            f"\nTake roster.json (number {roster.number}) to every host: its agent uses it within "
            "a minute."
        )


def _show(roster: Roster, *, own: Subject | None = None, as_json: bool) -> None:
    today = datetime.now(UTC).date()
    if as_json:
        print_json(
            {
                "cell": roster.cell,
                "number": roster.number,
                "subjects": {
                    subject.name: {
                        "role": subject.role,
                        "generation": subject.generation,
                        "expires": subject.ends.date().isoformat(),
                        "days": (subject.ends.date() - today).days,
                    }
                    for subject in roster.subjects.values()
                },
                "revoked": len(roster.revoked),
            }
        )
        return
    rows: list[Sequence[str]] = [
        (
            subject.name,
            subject.role,
            str(subject.generation),
            subject.ends.date().isoformat(),
            _remark((subject.ends.date() - today).days),
            "this keyring" if subject == own else "",
        )
        for subject in roster.certificates
    ]
    typer.echo(f"cell {roster.cell}, roster {roster.number}, {len(roster.revoked)} revoked\n")
    typer.echo(aligned(("subject", "role", "generation", "ends", "", ""), rows))


def _remark(days: int) -> str:
    from dwell.live.trust.keyring import SOON_DAYS

    if days < 0:
        return "has ended"
    return f"in {days} days" if days < SOON_DAYS else ""
