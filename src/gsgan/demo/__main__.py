"""``python -m gsgan.demo``: a picture and a video of the avatar that comes with gsgan."""

from gsgan.utils.config import entry

main = entry(
    "demo",
    task="gsgan.demo.run.demo",
    options="gsgan.demo.run.DemoOptions",
)

if __name__ == "__main__":
    main()
