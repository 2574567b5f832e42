"""``python -m gsgan.check data=…``: check a dataset before training."""

import sys

from omegaconf import DictConfig

from gsgan.utils.checks import one_of
from gsgan.utils.config import FAILED, entry


def check(config: DictConfig) -> None:
    """Checks the dataset, prints and writes a report; ends with 1 when something is wrong.

    With ``strict`` a warning is enough for that.

    Raises:
        GsganError: on a config value that does not fit.
    """
    from gsgan.check.run import run_check

    one_of("strict", config.strict, (True, False))
    report = run_check(config)
    if report.errors or (config.strict and report.warnings):
        sys.exit(FAILED)


main = entry("check", check)

if __name__ == "__main__":
    main()
