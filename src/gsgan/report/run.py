"""The tables and figures that the options of gsgan.report ask for."""

from dataclasses import dataclass

from gsgan.report.figures.run import FigureOptions, make_figures
from gsgan.report.table import TableOptions, make_tables
from gsgan.utils.config import CommandOptions
from gsgan.utils.errors import ConfigError


@dataclass(frozen=True)
class ReportOptions(CommandOptions):
    """The options of gsgan.report: conf/report.yaml."""

    tables: TableOptions
    of_run: FigureOptions


def report(options: ReportOptions) -> None:
    """Makes the tables of ``runs`` and the figures of ``run``."""
    runs = options.tables.runs
    run = options.of_run.source.run
    if not runs and run is None:
        raise ConfigError(
            "runs and run are not set: give runs=[<run folder>,<sweep folder>,…] for tables, or "
            "run=<run folder> for figures"
        )
    if runs:
        make_tables(options.tables)
    if run is not None:
        make_figures(options.of_run)
