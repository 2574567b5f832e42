"""``python -m gsgan.evaluate``: score a run, or any method's images, on the held-out splits."""

from gsgan.utils.config import entry

main = entry("evaluate", "gsgan.evaluate.run.evaluate_config")

if __name__ == "__main__":
    main()
