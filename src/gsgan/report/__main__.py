"""``python -m gsgan.report``: tables of scored runs (runs=[…]) and figures of one run (run=…)."""

from gsgan.utils.config import entry

main = entry(
    "report",
    task="gsgan.report.run.report",
    options="gsgan.report.run.ReportOptions",
)

if __name__ == "__main__":
    main()
