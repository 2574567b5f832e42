"""``python -m gsgan.fit data.root=<folder>``: the body and its poses that fit the masks."""

from gsgan.utils.config import entry

main = entry(
    "fit",
    task="gsgan.fit.run.run_fit",
    options="gsgan.fit.run.FitOptions",
)

if __name__ == "__main__":
    main()
