"""``python -m gsgan.prepare source=<folder> out=<folder>``: videos to a capture for training."""

from omegaconf import DictConfig

from gsgan.utils.config import entry


def prepare(config: DictConfig) -> None:
    """Makes the dataset ``config.out`` from the videos and calibration in ``config.source``."""
    from hydra.utils import instantiate

    from gsgan.prepare.options import Options
    from gsgan.prepare.run import prepare as run
    from gsgan.utils.console import make_console

    run(Options(**instantiate(config, _convert_="all")), make_console())


main = entry("prepare", prepare)

if __name__ == "__main__":
    main()
