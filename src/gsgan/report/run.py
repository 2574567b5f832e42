"""The command: finds runs, builds the table, writes and prints it."""

from __future__ import annotations

from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig

from gsgan.report.build import build
from gsgan.report.folders import find_runs, read_runs
from gsgan.report.grid import Report
from gsgan.report.paper import read_paper
from gsgan.report.spec import TableSpec
from gsgan.report.writers import html, latex, markdown, numbers
from gsgan.report.writers.terminal import print_report
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.pages import check_block, fill_block

WRITERS = {
    "report.md": markdown.page,
    "report.tex": latex.page,
    "report.html": html.page,
    "report.json": numbers.text,
}
CURVES = "report.png"
BLOCK_END = "<!-- /report -->"


def run_report(config: DictConfig) -> Report:
    """``gsgan.report``: the table ``config.table`` of ``config.runs``, into ``config.out``.

    Raises:
        ConfigError: on runs that are not there or do not belong into one table, or on a page or
            folder that cannot be written.
    """
    given = _given(config.runs)
    if not config.out:
        raise ConfigError("out is not set: give the folder that the tables are written into")
    if not isinstance(config.allow_dirty, bool):
        raise ConfigError(f"allow_dirty must be true or false, got {config.allow_dirty!r}")
    spec: TableSpec = instantiate(config.table)
    paper = None if spec.paper is None else read_paper(spec.paper)
    page = None if config.fill is None else Path(str(config.fill)).expanduser()
    if page is not None:
        check_block(page, _start(spec), BLOCK_END, key="fill")
    runs, left_out = read_runs(find_runs(given))
    report = build(spec, runs, left_out, paper, allow_dirty=config.allow_dirty)
    folder = Path(str(config.out)).expanduser()
    try:
        for name, text in WRITERS.items():
            write_atomically(folder / name, text(report))
        curves = _curves(report) if spec.by else None
        if curves is not None:
            write_atomically(folder / CURVES, curves)
        if page is not None:
            fill_block(page, _start(spec), BLOCK_END, markdown.block(report), key="fill")
    except OSError as error:
        where = error.filename or folder
        raise ConfigError(f"{where} cannot be written: {error.strerror}") from None
    console = make_console()
    print_report(report, console)
    files = [*WRITERS, *([] if curves is None else [CURVES])]
    console.print(f"tables: {folder}/{{{','.join(files)}}}", markup=False, soft_wrap=True)
    if page is not None:
        console.print(f"filled: {page}", markup=False, soft_wrap=True)
    return report


def _given(runs: object) -> list[str]:
    if runs is None or runs == "" or (isinstance(runs, ListConfig) and not runs):
        raise ConfigError(
            "runs is not set: give runs=[<run folder>,<sweep folder>,…] of gsgan.train or "
            "gsgan.evaluate"
        )
    if isinstance(runs, str):
        return [runs]
    if not isinstance(runs, ListConfig):
        raise ConfigError(f"runs must be a list of folders, got {runs!r}")
    return [str(run) for run in runs]


def _curves(report: Report) -> bytes | None:
    from gsgan.report.writers.curves import picture  # here: it brings matplotlib

    return picture(report)


def _start(spec: TableSpec) -> str:
    return f"<!-- report:{spec.name} -->"
