"""``python -m gsgan.fit data.root=<folder>``: the body and its poses that fit the masks."""

from gsgan.utils.config import entry

main = entry("fit", "gsgan.fit.run.run_fit")

if __name__ == "__main__":
    main()
