"""``python -m gsgan.report``: tables of scored runs (runs=[…]) and figures of one run (run=…)."""

from omegaconf import DictConfig

from gsgan.utils.config import entry
from gsgan.utils.errors import ConfigError


def report(config: DictConfig) -> None:
    """Makes the tables of ``config.runs`` and the figures of ``config.run``."""
    if not config.runs and config.run is None:
        raise ConfigError(
            "runs and run are not set: give runs=[<run folder>,<sweep folder>,…] for tables, or "
            "run=<run folder> for figures"
        )
    if config.runs:
        from gsgan.report.table import make_tables

        make_tables(config)
    if config.run is not None:
        from gsgan.report.figures.run import make_figures

        make_figures(config)


main = entry("report", report)

if __name__ == "__main__":
    main()
