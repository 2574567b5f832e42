"""``python -m gsgan.export``: write an avatar in the format of other programs."""

from gsgan.utils.config import entry

main = entry(
    "export",
    task="gsgan.export.run.export",
    options="gsgan.export.run.ExportOptions",
)

if __name__ == "__main__":
    main()
