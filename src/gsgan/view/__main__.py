"""``python -m gsgan.view``: look at a trained avatar in the browser, play motions, drag joints."""

from gsgan.utils.config import entry

main = entry(
    "view",
    task="gsgan.view.server.view",
    options="gsgan.view.server.ViewOptions",
)

if __name__ == "__main__":
    main()
