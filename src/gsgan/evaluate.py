"""``python -m gsgan.evaluate run=<folder>``: score a run on held-out cameras and poses."""

from __future__ import annotations

from omegaconf import DictConfig

from gsgan.config import entry


def evaluate(config: DictConfig) -> None:
    """Scores the run folder ``config.run``.

    Raises:
        GsganError: on anything the user can put right.
    """
    from gsgan.evaluation import evaluate_folder

    evaluate_folder(config)


main = entry("evaluate")(evaluate)

if __name__ == "__main__":
    main()
