"""``python -m gsgan.evaluate``: score a run, or any method's images, on the held-out splits."""

from omegaconf import DictConfig

from gsgan.utils.config import entry


def evaluate(config: DictConfig) -> None:
    """Scores the run folder ``config.run`` or the images in ``config.predictions``."""
    from gsgan.evaluate.run import evaluate_config

    evaluate_config(config)


main = entry("evaluate")(evaluate)

if __name__ == "__main__":
    main()
