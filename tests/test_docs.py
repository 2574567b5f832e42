"""The docs say what is there: pages, links, budgets, the comments of conf/, the website."""

import importlib
import re
import subprocess
import sys
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
CONF, DOCS = ROOT / "conf", ROOT / "docs"
TOP = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
RESULTS = sorted((DOCS / "results").glob("*.md"))
WRITTEN = sorted(set(DOCS.rglob("*.md")) - set(RESULTS))  # by a person
PROSE = [ROOT / "README.md", *WRITTEN]
PAGES = [*(ROOT / name for name in TOP), *WRITTEN, *RESULTS]
COMMENT = re.compile(r"(^|\s)#\s")


def names(pages: list[Path]) -> list[str]:
    return [str(page.relative_to(ROOT)) for page in pages]


def anchors(page: Path) -> set[str]:
    """As GitHub and mkdocs make them of headings."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, flags=re.M)
    return {
        re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-")
        for title in titles
    }


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_links_and_images_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target, anchor in re.findall(r"\]\(([^)#]*)(?:#([^)]+))?\)", text):
        if target.startswith("http"):
            continue
        linked = page.parent / target if target else page
        assert linked.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(linked), (
            f"{page.name}: {target}#{anchor}"
        )


def test_pages_named_in_the_code_exist():
    for folder in ("src", "conf", "scripts"):
        for path in (
            p
            for p in (ROOT / folder).rglob("*")
            if p.suffix in (".py", ".yaml", ".sh")
        ):
            for page in re.findall(r"docs/[a-z_/]+\.md", path.read_text()):
                assert (
                    ROOT / page
                ).exists() or page == "docs/results/gpu.md", f"{path}: {page}"


@pytest.mark.parametrize("page", RESULTS, ids=names(RESULTS))
def test_results_name_commit_machine_and_date(page):
    text = page.read_text()
    assert re.search(r"[Cc]ommits?[:\s]", text), "no commit (or: not recorded)"
    assert re.search(r"[Mm]achine|\(cpu\)|\(cuda\)", text), (
        "no machine (or: not recorded)"
    )
    assert re.search(r"20\d\d-\d\d-\d\d|date: not recorded", text), (
        "no date (or: not recorded)"
    )


NUMBER = re.compile(
    r"(?<![\w.])\d+\.\d+(?!\.?\d)|(?<![\w.])\d+(?= (?:dB|%|ms|s|MB|GB|images a second)(?!\w))"
)
# Numbers that no page of results has: versions, sizes of downloads, constants of a formula, and
# the ratio of two numbers of one table.
NOT_MEASURED = {
    "README.md": "3.11",
    "docs/ablations.md": "0.38",
    "docs/default_person.md": "2.4",
    "docs/effects.md": "0.0008",
    "docs/export.md": "2.2.0",
    "docs/formats.md": "0.187 1.7 2.2.0 2.4.0 2.7.1 26.11",
    "docs/one_camera.md": "43.3",
    "docs/prepare.md": "0.1 1.7 3.11 3.12",
    "docs/quickstart.md": "3.11",
    "docs/reliability.md": "0.8 1.3.8 3.11 3.12 3.13 3.14",
    "docs/render.md": "106",
    "docs/report.md": "7.16",
    "docs/train.md": "0.31 2.21 233 3.17 528",
}


def unproven(text: str, results: str, exceptions: str = "") -> list[str]:
    """Measured numbers of a text, commands left out, that stand in no page of results.

    A number stands in a page if one of the page's numbers rounds to it.
    """
    prose = re.sub(
        r"```.*?```|`[^`]*`|\]\([^)]*\)|<!--.*?-->", "", text, flags=re.S
    )
    stored = set(re.findall(r"(?<![\d.])\d+(?:\.\d+)?(?![\d.]*\d)", results))

    found = set()
    numbers = set(NUMBER.findall(prose)) - set(exceptions.split())
    for number in numbers - stored:
        decimals = len(number.partition(".")[2])
        rounded = {
            f"{float(value):.{decimals}f}" for value in stored if "." in value
        }
        if number not in rounded:
            found.add(number)
    return sorted(found)


@pytest.mark.parametrize("page", PROSE, ids=names(PROSE))
def test_every_measured_number_stands_in_a_page_of_results(page):
    results = "\n".join(page.read_text() for page in RESULTS)
    exceptions = NOT_MEASURED.get(str(page.relative_to(ROOT)), "")
    assert not unproven(page.read_text(), results, exceptions)


def test_a_number_without_a_result_is_found():
    text = "39.17 and 39.2 dB, 12 % more, `x=0.5`, v1.2.3. 7.5 s"
    assert unproven(text, "39.173 dB", "7.5") == ["12"]
    assert unproven("9.17 dB", "39.17 dB") == ["9.17"]


def words(pages: list[Path]) -> int:
    """As ``wc -w`` counts them."""
    return sum(len(page.read_text().split()) for page in pages)


def test_docs_are_short():
    assert words(PROSE + RESULTS) <= 45_000
    assert words(RESULTS) <= 15_000


# Commands, and what scripts write.
UNWRAPPED = re.compile(r"```.*?```|<!-- bench:.*?<!-- end -->", re.DOTALL)
NO_PROSE = re.compile(r"\s*(\||#|!\[|:::|<)")
LIST_ITEM = re.compile(r"^\s*([-*]|\d+\.) ")


def prose_lines(text: str) -> list[str]:
    """Lines of paragraphs and lists; empty where a paragraph ends."""
    lines = UNWRAPPED.sub("", text).splitlines()
    return ["" if NO_PROSE.match(line) else line for line in lines]


def sentences(text: str) -> list[str]:
    """Of paragraphs and list items, code and the targets of links left out."""
    paragraphs = [""]
    for line in prose_lines(text):
        if not line.strip() or LIST_ITEM.match(line):
            paragraphs.append("")
        paragraphs[-1] += f" {LIST_ITEM.sub('', line).strip()}"
    found = []
    for paragraph in paragraphs:
        plain = re.sub(r"`[^`]*`", "code", paragraph)
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", plain)
        found += re.split(r"(?<=[.!?])[*\"')]*\s+", plain)
    return found


@pytest.mark.parametrize("page", PROSE + RESULTS, ids=names(PROSE + RESULTS))
def test_sentences_have_at_most_40_words(page):
    for sentence in sentences(page.read_text()):
        count = len(re.findall(r"\S*\w\S*", sentence))
        assert count <= 40, sentence


@pytest.mark.parametrize("page", PROSE + RESULTS, ids=names(PROSE + RESULTS))
def test_text_is_wrapped_at_100_columns(page):
    for line in prose_lines(page.read_text()):
        assert len(line) <= 100 or " " not in line.strip(), line


def test_a_long_sentence_is_found():
    text = "Short. " + "word " * 41 + "end.\n\n| " + "cell " * 50 + "|\n"
    assert [len(x.split()) > 40 for x in sentences(text) if x.strip()] == [
        False,
        True,
    ]


def test_every_page_is_in_the_website():
    nav = (ROOT / "mkdocs.yml").read_text()
    for page in (*WRITTEN, *RESULTS):
        assert re.search(rf"- {page.relative_to(DOCS)}$", nav, flags=re.M), page


def test_the_reference_lists_modules_that_exist():
    listed = re.findall(
        r"^::: ([\w.]+)$", (DOCS / "reference.md").read_text(), flags=re.M
    )
    for part in (
        "scene",
        "skeleton",
        "splat",
        "body",
        "losses",
        "metrics",
        "model",
        "data",
    ):
        assert any(name.startswith(f"gsgan.{part}") for name in listed), part
    for name in listed:
        assert find_spec(name) is not None, name


@pytest.mark.slow
def test_the_website_builds_without_a_warning(tmp_path):
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--site-dir",
        str(tmp_path),
    ]
    done = subprocess.run(
        command, cwd=ROOT, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert (
        'id="gsgan.scene.Camera"'
        in (tmp_path / "reference" / "index.html").read_text()
    )


def keys(path: Path) -> list[tuple[str, int]]:
    """Every public key with a value of its own, with its line, from 0; none of Hydra's."""
    found: list[tuple[str, int]] = []

    def walk(node: yaml.Node) -> None:
        for key, value in (
            node.value if isinstance(node, yaml.MappingNode) else ()
        ):
            name = key.value
            if name in ("defaults", "hydra") or name.startswith("_"):
                continue
            if isinstance(value, yaml.MappingNode):
                walk(value)
            else:
                found.append((name, key.start_mark.line))

    walk(yaml.compose(path.read_text()))
    return found


def has_comment(lines: list[str], number: int) -> bool:
    """On its line, or above it in its block, which ends at an empty line."""
    above = takewhile(str.strip, reversed(lines[:number]))
    return bool(COMMENT.search(lines[number])) or any(
        x.strip().startswith("#") for x in above
    )


def test_every_key_of_conf_has_a_comment():
    explained, missing = set(), []
    for path in sorted(CONF.rglob("*.yaml")):
        lines = path.read_text().splitlines()
        for name, number in keys(path):
            if has_comment(lines, number):
                explained.add(name)
            else:
                missing.append(
                    (name, f"{path.relative_to(CONF)}:{number + 1}: {name}")
                )
    # a preset need not repeat what the file says that it changes
    lacking = [where for name, where in missing if name not in explained]
    assert not lacking, "\n".join(lacking)


def test_the_architecture_page_maps_every_package_of_the_code():
    text = (DOCS / "architecture.md").read_text()
    for folder in sorted((ROOT / "src" / "gsgan").iterdir()):
        if folder.is_dir() and (folder / "__init__.py").is_file():
            assert f"`{folder.name}/`" in text, folder.name


def test_make_targets_of_the_docs_exist():
    targets = set(
        re.findall(
            r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(), flags=re.M
        )
    )
    for page in PAGES:
        used = re.findall(
            r"^make ([a-z-]+)|`make ([a-z-]+)", page.read_text(), flags=re.M
        )
        assert {first or second for first, second in used} <= targets, page.name


def test_ci_calls_the_readmes_test_command():
    assert "make test" in (ROOT / ".ci" / "run").read_text()
    assert "make test" in (ROOT / "README.md").read_text()


def test_the_age_of_a_pages_figures_counts_from_the_commits_that_it_names(
    tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    figures_age = importlib.import_module("figures_age")
    page = tmp_path / "page.md"
    page.write_text("Commit d9dcc37, later 818c7cf8d32a; 1234567 is no commit.")
    later = {"d9dcc37": 11, "818c7cf": 4, "0000000": 2}
    assert figures_age.ages(page, later) == [4, 11]
