"""``python -m gsgan.check data=…``: look a dataset over before any training."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from gsgan.config import FAILED, entry


def check(config: DictConfig) -> None:
    """Checks the dataset, prints and writes a report; ends with 1 when something is wrong.

    Raises:
        GsganError: on a config value that does not fit.
    """
    from gsgan.checking.run import run_check

    if run_check(config).errors:
        sys.exit(FAILED)


main = entry("check")(check)

if __name__ == "__main__":
    main()
