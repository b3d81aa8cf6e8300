"""Make the site from the pages: `make docs` (`python -m docs.site`).

Copies pages, pictures and the files that they link to into build/site-source, with the folders of
the repository, so links work as they are. Zensical makes build/site in strict mode. Fails if the
site would load anything from another host.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE, SITE = ROOT / "build" / "site-source", ROOT / "build" / "site"
API, STYLES = "docs/reference/api.md", "docs/site.css"
LINK = re.compile(r"\]\(([^)\s#]+)(?:#[^)\s]*)?\)")
#: Text and target of a link on the page of all pages.
NAMED_LINK = re.compile(r"\[([^\]]+)\]\(([^)\s#]+)\)")
#: A name with its own entry on the page of the Python interface.
NAME = re.compile(r"^\| `(dwell[\w.]*)` \|", re.MULTILINE)
#: Attributes by which a page loads a file.
LOADED = re.compile(r"""<(?:script|img|iframe|source)\b[^>]*?\bsrc=["']?(https?:)?//""")
STYLE = re.compile(
    r"""<link\b(?=[^>]*\brel=["']?(?:stylesheet|preconnect|icon))[^>]*href=["']?https?:"""
)
TITLE = re.compile(r"^# (.+)$", re.MULTILINE)
SECTIONS = {
    "Start": "start",
    "How to": "howto",
    "Reference": "reference",
    "Background": "background",
}
#: Pages of docs itself, which begin the section Background.
RULES = ("docs/concepts.md", "docs/guard.md", "docs/live-protocol.md", "docs/architecture.md")


def linked(page: str, text: str) -> set[str]:
    """Return the files and folders that a page links to, from the root of the repository."""
    targets = (target for target in LINK.findall(text) if not re.match(r"[a-z]+:", target))
    folder = (ROOT / page).parent
    return {str((folder / target).resolve().relative_to(ROOT)) for target in targets}


def pages() -> dict[str, str]:
    """Return the text of each page by its path: docs, and all pages that these link to."""
    found: dict[str, str] = {}
    open_pages = [str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")]
    open_pages.append("README.md")
    while open_pages:
        page = open_pages.pop()
        if page in found or not (ROOT / page).is_file():  # Zensical names missing pages.
            continue
        found[page] = (ROOT / page).read_text(encoding="utf-8")
        open_pages += [name for name in linked(page, found[page]) if name.endswith(".md")]
    return found


def with_entries(text: str) -> str:
    """Return the page of the Python interface with the docstring of each name."""
    return text + "".join(f"\n## `{name}`\n\n::: {name}\n" for name in NAME.findall(text))


def stage(folder: Path) -> dict[str, str]:
    """Write the sources of the site into a folder; return the pages."""
    found = pages()
    others = {name for page, text in found.items() for name in linked(page, text)} - found.keys()
    for name in sorted({*others, STYLES}):
        if (ROOT / name).is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, target)
    for page, text in found.items():
        target = folder / page
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(with_entries(text) if page == API else text, encoding="utf-8")
    return found


def title(text: str) -> str:
    """Return the heading of a page without marks."""
    heading = TITLE.search(text)
    return heading[1].replace("`", "") if heading else "Page"


def navigation(found: dict[str, str]) -> list[object]:
    """Return the navigation of the site: pages by folder, as the index names and orders them."""
    links = NAMED_LINK.findall(found["docs/index.md"])
    names = {os.path.normpath(f"docs/{target}"): name for name, target in links}
    order = [*names]
    listed = sorted(found, key=lambda page: order.index(page) if page in order else len(order))

    def entry(page: str) -> dict[str, str]:
        name = names.get(page) or title(found[page])
        return {name[0].upper() + name[1:]: page}

    def entries(folder: Path) -> list[dict[str, str]]:
        return [entry(page) for page in listed if Path(page).parent == folder]

    docs = Path("docs")
    sections = {name: entries(docs / folder) for name, folder in SECTIONS.items()}
    sections["Background"] = [*map(entry, RULES), *sections["Background"]]
    return [
        {"Dwell": "README.md"},
        {"All pages": "docs/index.md"},
        *({name: pages} for name, pages in sections.items()),
        {"Laboratory": entries(Path("lab/docs"))},
        {"Evidence": entries(Path("reproduction/evidence"))},
    ]


def _palette(preference: str, scheme: str, icon: str) -> dict[str, object]:
    toggle = {"icon": f"lucide/{icon}", "name": "Switch between light and dark"}
    media = f"(prefers-color-scheme: {preference})"
    return {"media": media, "scheme": scheme, "toggle": toggle}


def settings(found: dict[str, str]) -> dict[str, object]:
    """Return the settings of Zensical."""
    handler = {
        "paths": [str(ROOT / "src")],
        "options": {
            "docstring_style": "numpy",
            "heading_level": 3,
            "show_root_heading": False,
            "show_root_toc_entry": False,
            "show_source": False,
            "members": False,
        },
    }
    return {
        "site_name": "Dwell",
        "docs_dir": SOURCE.name,
        "site_dir": SITE.name,
        "use_directory_urls": False,
        "extra_css": [STYLES],
        "theme": {
            "font": False,
            "features": ["navigation.sections", "search.highlight"],
            "palette": [_palette("light", "default", "moon"), _palette("dark", "slate", "sun")],
        },
        "nav": navigation(found),
        "markdown_extensions": {
            "tables": {},
            "fenced_code": {},
            "toc": {"permalink": True},
            "pymdownx.highlight": {},
            "pymdownx.superfences": {},
        },
        "plugins": [{"mkdocstrings": {"handlers": {"python": handler}}}],
    }


def external(folder: Path) -> list[str]:
    """Return the pages that would load a file from another host."""
    return [
        str(page.relative_to(folder))
        for page in sorted(folder.rglob("*.html"))
        if LOADED.search(text := page.read_text(encoding="utf-8")) or STYLE.search(text)
    ]


def main() -> int:
    """Make the site; return 1 if Zensical warns or a page loads from another host."""
    shutil.rmtree(SOURCE, ignore_errors=True)
    found = stage(SOURCE)
    file = SOURCE.parent / "mkdocs.yml"
    file.write_text(json.dumps(settings(found), ensure_ascii=False, indent=1), encoding="utf-8")
    shutil.rmtree(SITE, ignore_errors=True)
    made = subprocess.run(
        (sys.executable, "-m", "zensical", "build", "--clean", "--strict", "-f", str(file)),
        check=False,
    )
    if made.returncode:
        return 1
    if pages_outside := external(SITE):
        print(f"loads from another host: {', '.join(pages_outside)}", file=sys.stderr)
        return 1
    print(f"site: {SITE / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
