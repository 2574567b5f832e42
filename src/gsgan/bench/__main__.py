"""``python -m gsgan.bench speed [key=value]``: milliseconds from skeleton to image, by stage."""

import sys

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


def main() -> None:
    """Passes the command line, without its first word, to Hydra."""
    # Hydra's own help would not name the first word.
    if sys.argv[1:2] in (["--help"], ["-h"]):
        print(HELP)
        return
    if sys.argv[1:2] != [SUBJECT]:
        sys.exit(OTHERS)
    del sys.argv[1]
    entry(
        "bench_speed",
        task="gsgan.bench.speed.run",
        options="gsgan.bench.speed.SpeedOptions",
    )()


if __name__ == "__main__":
    main()
