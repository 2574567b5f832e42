"""Tables and the blocks of a page."""

from __future__ import annotations

import csv
import io

import pytest

from gsgan.bench.tables import csv_text, fill_block, markdown, number
from gsgan.utils.errors import ConfigError


def test_markdown_has_as_many_columns_everywhere():
    lines = markdown(["a", "b"], [["1", "x|y"], ["2", "two\nlines"]]).splitlines()
    assert lines == ["| a | b |", "| --- | --- |", "| 1 | x\\|y |", "| 2 | two lines |"]


def test_csv_reads_back():
    text = csv_text(["a", "b"], [[1, None], ["x,y", 2.5]])
    assert list(csv.reader(io.StringIO(text))) == [["a", "b"], ["1", ""], ["x,y", "2.5"]]


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [
        (None, 3, "–"),
        (0.0, 3, "0.00"),
        (1.2345, 3, "1.23"),
        (123.4, 3, "123"),
        (12345.6, 3, "12346"),
        (0.0123, 2, "0.012"),
        (1.26e-5, 2, "1.3e-05"),
        (-2.5e-6, 2, "-2.5e-06"),
    ],
)
def test_numbers_have_their_significant_digits(value, digits, shown):
    assert number(value, digits) == shown


def test_a_block_is_replaced_and_nothing_else(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("A\n<!-- bench:one -->\nold\n<!-- end -->\nB\n<!-- bench:two --><!-- end -->C")
    for _ in range(2):  # twice is the same as once
        fill_block(page, "one", "new\n")
        text = page.read_text()
        assert text == (
            "A\n<!-- bench:one -->\n\nnew\n\n<!-- end -->\nB\n<!-- bench:two --><!-- end -->C"
        )


@pytest.mark.parametrize("text", ["nothing", "<!-- bench:one --> not closed"])
def test_a_page_without_the_block_is_refused_untouched(tmp_path, text):
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ConfigError, match=r"page\.md: expected a block <!-- bench:one -->"):
        fill_block(page, "one", "new")
    assert page.read_text() == text


def test_a_missing_page_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"absent\.md: no such page"):
        fill_block(tmp_path / "absent.md", "one", "new")
