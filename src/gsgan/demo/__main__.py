"""``python -m gsgan.demo``: a picture and a video of the avatar that comes with gsgan."""

from gsgan.utils.config import entry

main = entry("demo", "gsgan.demo.run.demo_config")

if __name__ == "__main__":
    main()
