"""``python -m gsgan.evaluate``: score a run, or any method's pictures, on what was held out."""

from __future__ import annotations

from omegaconf import DictConfig

from gsgan.utils.config import entry


def evaluate(config: DictConfig) -> None:
    """Scores the run folder ``config.run``, or the pictures in ``config.predictions``.

    Raises:
        GsganError: on anything the user can put right.
    """
    from gsgan.evaluate.command import evaluate_config

    evaluate_config(config)


main = entry("evaluate")(evaluate)

if __name__ == "__main__":
    main()
