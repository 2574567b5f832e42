"""``python -m gsgan.figures run=<folder>``: the paper's figures from any run."""

from __future__ import annotations

from omegaconf import DictConfig

from gsgan.utils.config import entry


def figures(config: DictConfig) -> None:
    """Draws the figures of ``config.run``, beside the runs of ``config.compare``.

    Raises:
        GsganError: on anything the user can put right.
    """
    from gsgan.report.figures.run import make_figures  # loads matplotlib

    make_figures(config)


main = entry("figures")(figures)

if __name__ == "__main__":
    main()
