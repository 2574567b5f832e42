"""``python -m gsgan.bench speed [key=value]``: milliseconds from skeleton to image, by stage."""

import sys
from pathlib import Path

from omegaconf import DictConfig

from gsgan.utils.config import entry

SUBJECT = "speed"
OTHERS = (
    "gsgan: the first word must be speed; the other benchmarks are in scripts/bench of "
    "a checkout"
)
HELP = """\
python -m gsgan.bench speed [key=value]   milliseconds from skeleton to image, by stage
python -m gsgan.bench speed --help        its options
Other benchmarks are in scripts/bench of a checkout."""


def bench(config: DictConfig) -> None:
    """Times an avatar and writes the result into Hydra's output folder."""
    # The imports take long, so they come after Hydra has read the command line.
    from hydra.core.hydra_config import HydraConfig

    from gsgan.bench.speed import run

    run(config, Path(HydraConfig.get().runtime.output_dir))


def main() -> None:
    """Passes the command line, without its first word, to Hydra."""
    # Hydra's own help would not name the first word.
    if sys.argv[1:2] in (["--help"], ["-h"]):
        print(HELP)
        return
    if sys.argv[1:2] != [SUBJECT]:
        sys.exit(OTHERS)
    del sys.argv[1]
    entry("bench_speed", bench)()


if __name__ == "__main__":
    main()
