"""``python -m gsgan.train``: train an avatar, then score it on what was held out."""

from omegaconf import DictConfig

from gsgan.utils.config import entry


def train(config: DictConfig) -> None:
    """Builds data, avatar and training from the config, fits, evaluates."""
    from gsgan.train.run import run_training

    run_training(config)


main = entry("train")(train)

if __name__ == "__main__":
    main()
