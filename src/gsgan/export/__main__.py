"""``python -m gsgan.export``: write an avatar in the format of other programs."""

from omegaconf import DictConfig

from gsgan.utils.config import entry


def export(config: DictConfig) -> None:
    """Writes the avatar of ``config.run`` to ``config.out``, or reads ``config.verify``."""
    from gsgan.export.run import export_config

    export_config(config)


main = entry("export")(export)

if __name__ == "__main__":
    main()
