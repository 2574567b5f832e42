"""``python -m gsgan.check data=…``: check a dataset before training."""

from gsgan.utils.config import entry

main = entry(
    "check",
    task="gsgan.check.run.check",
    options="gsgan.check.run.CheckOptions",
)

if __name__ == "__main__":
    main()
