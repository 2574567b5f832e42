"""``python -m gsgan.report``: tables of scored runs (runs=[…]) and figures of one run (run=…)."""

from __future__ import annotations

from omegaconf import DictConfig

from gsgan.utils.config import entry


def report(config: DictConfig) -> None:
    """Makes the tables of ``config.runs`` and the figures of ``config.run``."""
    from gsgan.report.run import run_report

    run_report(config)


main = entry("report")(report)

if __name__ == "__main__":
    main()
