"""``python -m gsgan.report runs=[…] table=…``: tables of scored runs, the paper's beside them."""

from __future__ import annotations

from omegaconf import DictConfig

from gsgan.utils.config import entry


def report(config: DictConfig) -> None:
    """Gathers the runs ``config.runs`` into the table ``config.table``.

    Raises:
        GsganError: on anything the user can put right.
    """
    from gsgan.report.run import run_report

    run_report(config)


main = entry("report")(report)

if __name__ == "__main__":
    main()
