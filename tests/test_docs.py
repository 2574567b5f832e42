"""The docs say what is there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_options_page_is_up_to_date():
    script = ROOT / "scripts" / "make_options.py"
    done = subprocess.run([sys.executable, str(script), "--check"], check=False)
    assert done.returncode == 0, "run .venv/bin/python scripts/make_options.py"


def test_options_page_shows_every_config():
    page, conf = (ROOT / "docs" / "options.md").read_text(), ROOT / "conf"
    for path in conf.rglob("*.yaml"):
        assert f"\n## {path.relative_to(conf).with_suffix('')}\n" in page


@pytest.mark.parametrize(
    "page", ["README.md", *(f"docs/{p.name}" for p in sorted((ROOT / "docs").glob("*.md")))]
)
def test_links_and_pictures_exist(page):
    text = (ROOT / page).read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if not target.startswith("http"):
            assert ((ROOT / page).parent / target).exists(), f"{page}: {target}"


def test_readme_maps_every_package_of_the_code():
    text = (ROOT / "README.md").read_text()
    for folder in sorted((ROOT / "src" / "gsgan").iterdir()):
        if folder.is_dir() and (folder / "__init__.py").is_file():
            assert f"{folder.name}/" in text, folder.name


def test_make_verbs_of_the_readme_exist():
    text = (ROOT / "README.md").read_text()
    verbs = set(re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(), flags=re.M))
    for verb in re.findall(r"^make ([a-z-]+)|`make ([a-z-]+)", text, flags=re.M):
        assert (verb[0] or verb[1]) in verbs, verb


def test_ci_calls_the_readmes_test_command():
    assert "make test" in (ROOT / ".ci" / "run").read_text()
    assert "make test" in (ROOT / "README.md").read_text()
