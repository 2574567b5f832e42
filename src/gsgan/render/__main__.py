"""``python -m gsgan.render``: drive a trained avatar with a motion, into a video or PNG files."""

from omegaconf import DictConfig

from gsgan.utils.config import entry


def render(config: DictConfig) -> None:
    """Renders ``config.motion`` with the avatar of ``config.run`` into ``config.out``."""
    from gsgan.render.run import render_config

    render_config(config)


main = entry("render")(render)

if __name__ == "__main__":
    main()
