"""Says how old the figures of each page in docs/results are, in commits.

usage: python scripts/figures_age.py

A figure carries the commit it was measured at. For each page, this prints how many commits that
changed src or conf came after the oldest and after the newest commit that the page names.
"""

import re
import subprocess
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[1]
COMMIT = re.compile(r"\b[0-9a-f]{7,12}\b")


def git(*args: str) -> str:
    return subprocess.run(
        ["git", *args], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


def positions() -> dict[str, int]:
    """Of each commit's first seven digits: how many later commits changed src or conf."""
    changing = set(git("log", "--format=%H", "--", "src", "conf").split())
    found = {}
    later = 0
    for commit in git("log", "--format=%H").split():
        found[commit[:7]] = later
        later += commit in changing
    return found


def ages(page: Path, later: dict[str, int]) -> list[int]:
    """The age of every commit that the page names, newest first."""
    named = {commit[:7] for commit in COMMIT.findall(page.read_text())}
    return sorted(later[commit] for commit in named if commit in later)


def main() -> None:
    later = positions()
    table = Table(
        "page",
        "newest figure",
        "oldest figure",
        title="Commits to src or conf since",
    )
    for page in sorted((ROOT / "docs" / "results").glob("*.md")):
        found = ages(page, later)
        newest, oldest = (
            (str(found[0]), str(found[-1])) if found else ("none", "none")
        )
        table.add_row(page.name, newest, oldest)
    Console().print(table)


if __name__ == "__main__":
    main()
