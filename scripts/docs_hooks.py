"""Hooks of mkdocs.yml: the top level's pages in the website, with links that work there too."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#:]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages of the top level; their links to docs/ become relative to it."""
    for source, target in PAGES.items():
        text = (ROOT / source).read_text().replace("](docs/", "](")
        files.append(
            File.generated(config, target, content=LINK.sub(_at_top, text))
        )
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links from docs/ to those pages."""
    for source, target in PAGES.items():
        markdown = markdown.replace(f"](../{source}", f"]({target}")
    return markdown


def _at_top(link: re.Match[str]) -> str:
    """A link to another top page or into docs/; its text where the website lacks the file."""
    text, target, anchor = link[1], link[2], link[3] or ""
    if target in PAGES:
        return f"[{text}]({PAGES[target]}{anchor})"
    return link[0] if (ROOT / "docs" / target).exists() else text
