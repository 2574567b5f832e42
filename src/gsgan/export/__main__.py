"""``python -m gsgan.export``: write an avatar in the format of other programs."""

from gsgan.utils.config import entry

main = entry("export", "gsgan.export.run.export_config")

if __name__ == "__main__":
    main()
