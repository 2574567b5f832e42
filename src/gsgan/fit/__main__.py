"""``python -m gsgan.fit data.root=<folder>``: the body and its poses that fit the masks."""

from omegaconf import DictConfig

from gsgan.utils.config import entry


def fit(config: DictConfig) -> None:
    """Fits the body to the skeletons and masks of ``config.data``.

    Raises:
        GsganError: on anything the user can correct.
    """
    from gsgan.fit.run import run_fit

    run_fit(config)


main = entry("fit")(fit)

if __name__ == "__main__":
    main()
