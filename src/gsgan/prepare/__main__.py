"""``python -m gsgan.prepare source=<folder> out=<folder>``: videos to a capture for training."""

from gsgan.utils.config import entry

main = entry(
    "prepare",
    task="gsgan.prepare.run.prepare",
    options="gsgan.prepare.options.Options",
)

if __name__ == "__main__":
    main()
