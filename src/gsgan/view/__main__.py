"""``python -m gsgan.view``: look at a trained avatar in the browser, play motions, drag joints."""

from omegaconf import DictConfig

from gsgan.utils.config import entry


def view(config: DictConfig) -> None:
    """Serves the avatar of ``config.run`` until interrupted."""
    from gsgan.view.server import view_config

    view_config(config)


main = entry("view")(view)

if __name__ == "__main__":
    main()
