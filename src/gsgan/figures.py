"""``python -m gsgan.figures``: the old name of ``python -m gsgan.report run=<folder>``."""

from __future__ import annotations

import sys

from gsgan.report.__main__ import main as report


def main() -> None:
    """Names the new command, and does the work."""
    print("gsgan.figures is now python -m gsgan.report run=<folder>", file=sys.stderr)
    report()


if __name__ == "__main__":
    main()
