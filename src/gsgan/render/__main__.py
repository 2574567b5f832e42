"""``python -m gsgan.render``: drive a trained avatar with a motion, into a video or PNG files."""

from gsgan.utils.config import entry

main = entry(
    "render",
    task="gsgan.render.run.render",
    options="gsgan.render.run.RenderOptions",
)

if __name__ == "__main__":
    main()
