"""Tables of ``runs``: reads the runs, builds one table, writes it in every format."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.markdown import Markdown

from gsgan.report.paper import read_paper
from gsgan.report.runs import find_runs, read_runs
from gsgan.report.spec import TableSpec
from gsgan.report.table import build
from gsgan.report.write import MARKDOWN, TERMINAL, pages
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.pages import check_block, fill_block

CURVES = "report.png"
BLOCK_END = "<!-- /report -->"


def make_tables(config: DictConfig) -> None:
    """Writes the table ``config.table`` of ``config.runs`` into ``config.out``.

    Raises:
        ConfigError: on runs that do not exist or do not belong into one table, or on a page or
            folder that cannot be written.
    """
    given = [config.runs] if isinstance(config.runs, str) else config.runs
    spec: TableSpec = instantiate(config.table)
    paper = None if spec.paper is None else read_paper(spec.paper)
    page = None if config.fill is None else Path(str(config.fill)).expanduser()
    start = f"<!-- report:{spec.name} -->"
    if page is not None:
        check_block(page, start, BLOCK_END, key="fill")
    runs, left_out = read_runs(find_runs([str(entry) for entry in given]))
    report = build(spec, runs, left_out, paper, allow_dirty=config.allow_dirty)
    now = f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    folder = Path(str(config.out or f"runs/report/{now}")).expanduser()
    files: dict[str, str | bytes] = dict(pages(report))
    if spec.by:
        from gsgan.report.curves import curves  # here: it imports matplotlib

        files |= {CURVES: image} if (image := curves(report)) else {}
    try:
        for name, content in files.items():
            write_atomically(folder / name, content)
        if page is not None:
            fill_block(page, start, BLOCK_END, MARKDOWN.body(report), key="fill")
    except OSError as error:
        where = error.filename or folder
        raise ConfigError(f"{where} cannot be written: {error.strerror}") from None
    console = make_console()
    console.print(Markdown(TERMINAL.body(report)))
    filled = "" if page is None else f"\nfilled: {page}"
    done = f"tables: {folder}/{{{','.join(files)}}}{filled}"
    console.print(done, markup=False, soft_wrap=True)
