"""The documentation: examples run, commands exist, links lead somewhere."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest
import typer.main
from typer.testing import CliRunner

from docs import api, gallery, messages, replicas, site
from docs import commands as commands_page
from docs import metrics as metrics_page
from dwell.cli.commands import app

ROOT = Path(__file__).parents[1]
FOLDERS = ("docs", "lab", "reproduction")
PAGES = sorted(
    [*ROOT.glob("*.md"), *(page for name in FOLDERS for page in (ROOT / name).rglob("*.md"))]
)
EXECUTED = (
    "docs/start/first-result.md",
    "docs/reference/estimators.md",
    "docs/start/live-tutorial.md",
    "docs/howto/accelerators.md",
    "docs/howto/profiling.md",
    "docs/howto/studies.md",
    "docs/start/tutorial.md",
    "lab/docs/validation.md",
)

# They run until they are interrupted, or need those that do; tests/live/commands/test_live.py
# runs them.
LASTING = ("agent", "controller", "demo", "live")

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> Iterator[tuple[str, str, int]]:
    """Yield language, text and first line of every fenced block."""
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        yield match[1], match[2], text[: match.start(2)].count("\n") + 1


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of every command line."""
    for line in text.splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


def heading_anchors(page: Path) -> set[str]:
    """Return the anchors that a page's headings get."""
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    titles = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder with the examples, the current one."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", EXECUTED)
def test_examples_run(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From top to bottom in one namespace, as a reader would."""
    scope: dict[str, Any] = {"__name__": "example"}
    count = 0
    for language, text, line in blocks(ROOT / name):
        if language == "python":
            # Lines of a traceback are those of the page.
            exec(compile("\n" * (line - 1) + text, name, "exec"), scope)
            count += 1
        elif language == "sh":
            for words in commands(text):
                if words[0] == "dwell" and words[1] not in LASTING:
                    result = CliRunner().invoke(app, words[1:])
                    assert result.exit_code == 0, result.output
                    count += 1
    assert count > 0


def options(command: str) -> set[str]:
    """Return the options of a command and of its subcommands."""
    group: Any = typer.main.get_command(app)
    assert command in group.commands, f"there is no command {command!r}"
    found = group.commands[command]
    own = [found, *getattr(found, "commands", {}).values()]
    return {option for one in own for parameter in one.params for option in parameter.opts}


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_commands_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    lines = [text for language, text, _ in blocks(page) if language == "sh"]
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    lines += re.findall(r"`((?:dwell|make) [a-z][^`]*)`", prose)
    for words in (words for text in lines for words in commands(text)):
        if words[0] == "make":
            assert words[1] in targets
        elif words[0] == "dwell":
            used = {word.partition("=")[0] for word in words[2:] if word.startswith("--")}
            assert used <= options(words[1]) | {"--help"}


def test_the_page_of_public_names_is_the_generated_one() -> None:
    assert api.PAGE.read_text(encoding="utf-8") == api.page()


def test_the_page_of_messages_is_the_generated_one() -> None:
    assert messages.PAGE.read_text(encoding="utf-8") == messages.page()


def test_the_page_of_commands_is_the_generated_one() -> None:
    assert commands_page.PAGE.read_text(encoding="utf-8") == commands_page.page()


def test_the_page_of_metrics_is_the_generated_one() -> None:
    assert metrics_page.PAGE.read_text(encoding="utf-8") == metrics_page.page()


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_lead_somewhere(page: Path) -> None:
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    for target in LINK.findall(prose):
        if re.match(r"[a-z]+:", target):
            assert target.startswith("https://")
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), target
        assert linked.is_relative_to(ROOT), target
        if anchor:
            assert anchor in heading_anchors(linked), target


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_items_in_items_have_four_spaces(page: Path) -> None:
    """With fewer the site counts them as items of the outer list: rules get wrong numbers."""
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    assert re.findall(r"^ {1,3}[*-] .*", prose, re.MULTILINE) == []


def test_pictures_are_small() -> None:
    for picture in (ROOT / "docs" / "images").iterdir():
        assert picture.stat().st_size < 400_000


def test_the_site_has_each_page_and_what_it_links_to(tmp_path: Path) -> None:
    pages = site.stage(tmp_path)
    assert {page_name(page) for page in (ROOT / "docs").rglob("*.md")} <= pages.keys()
    assert not list((tmp_path / "docs").glob("*.py"))
    for page, text in pages.items():
        for name in site.linked(page, text):
            assert (tmp_path / name).is_file(), f"{page}: {name}"


@pytest.mark.parametrize(
    ("loaded", "is_external"),
    [
        ('<script src="https://example.org/a.js"></script>', True),
        ("<script src=//example.org/a.js></script>", True),
        ('<link rel="stylesheet" href="https://example.org/a.css">', True),
        ('<link href="https://example.org" rel="preconnect">', True),
        ('<script src="assets/a.js"></script><a href="https://example.org">link</a>', False),
    ],
)
def test_pages_that_load_from_another_host_are_found(
    loaded: str, is_external: bool, tmp_path: Path
) -> None:
    (tmp_path / "page.html").write_text(loaded)
    assert site.external(tmp_path) == ["page.html"] * is_external


@pytest.mark.parametrize("name", site.NAME.findall((ROOT / site.API).read_text(encoding="utf-8")))
def test_public_names_have_a_docstring(name: str) -> None:
    module, _, attribute = name.rpartition(".")
    public = importlib.import_module(module)
    assert attribute in public.__all__
    assert inspect.getdoc(pkgutil.resolve_name(f"{module}:{attribute}"))


@pytest.mark.parametrize("name", [picture.name for picture in gallery.PICTURES])
def test_a_page_has_each_picture_that_a_command_makes_with_its_data(name: str) -> None:
    assert any(f"images/{name}.svg" in page.read_text(encoding="utf-8") for page in PAGES)
    assert (gallery.IMAGES / f"{name}.csv").is_file()


def test_the_figure_of_replicas_has_the_shares_that_a_short_run_has() -> None:
    kept, found = pl.read_csv(replicas.IMAGES / "replicas.csv"), replicas.rows(windows=10, seeds=2)
    by = ["scenario", "policy", "at"]
    assert kept.select(by).equals(found.select(by))
    assert found["mean"].to_list() == pytest.approx(kept["mean"].to_list(), abs=1.0)
