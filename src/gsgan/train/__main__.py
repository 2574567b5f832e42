"""``python -m gsgan.train``: train an avatar, then score it on what was held out."""

from gsgan.utils.config import entry

main = entry(
    "train",
    task="gsgan.train.run.run_training",
    options="gsgan.train.run.TrainOptions",
)

if __name__ == "__main__":
    main()
