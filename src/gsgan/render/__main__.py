"""``python -m gsgan.render``: drive a trained avatar with a motion, into a video or PNG files."""

from gsgan.utils.config import entry

main = entry("render", "gsgan.render.run.render_config")

if __name__ == "__main__":
    main()
