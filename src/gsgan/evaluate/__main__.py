"""``python -m gsgan.evaluate``: score a run, or any method's images, on the held-out splits."""

from gsgan.utils.config import entry

main = entry(
    "evaluate",
    task="gsgan.evaluate.run.evaluate",
    options="gsgan.evaluate.run.EvaluateOptions",
)

if __name__ == "__main__":
    main()
