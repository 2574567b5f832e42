"""``python -m gsgan.bench <subject> [key=value]``: measure time, error and quality."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

from gsgan.utils.config import FAILED, entry

# Each is a module of gsgan.bench with run(config, folder), and a conf/bench_<subject>.yaml,
# both with _ for the subject's -.
SUBJECTS = {
    "raster": "time against error of every backend and accuracy setting of the rasteriser",
    "speed": "milliseconds from skeleton to image, by stage",
    "roofline": "the work of each stage of painting against the machine's peak",
    "trade-off": "quality against time and memory, over settings of a run or over many runs",
    "effects": "what each effect gains where it is called for, and costs (trains for an hour)",
}
REMOVED = {"stability": "the hard cases are tests: run `make stability` in a checkout"}
HELP = ("-h", "--help")


def split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """The subject, which is the first word that is no option or override, and the rest."""
    for i, word in enumerate(arguments):
        if "=" not in word and not word.startswith(("-", "+", "~")):
            return word, [*arguments[:i], *arguments[i + 1 :]]
    return None, list(arguments)


def main() -> None:
    """Passes the command line, less the subject, to Hydra."""
    subject, rest = split(sys.argv[1:])
    if subject is None and any(word in HELP for word in rest):
        print("python -m gsgan.bench <subject> [key=value], subjects:")
        for name, what in SUBJECTS.items():
            print(f"  {name:<10} {what}")
        print("Each answers --help with its whole config.")
        return
    if subject not in SUBJECTS:
        given = "nothing was given" if subject is None else f"{subject!r} is not one"
        message = f"the first word must be a subject ({', '.join(SUBJECTS)}); {given}"
        Console(stderr=True, soft_wrap=True).print(
            f"gsgan: {REMOVED.get(str(subject), message)}",
            style="bold red",
            markup=False,
            highlight=False,
        )
        sys.exit(FAILED)
    sys.argv = [sys.argv[0], *rest]
    name = subject.replace("-", "_")

    def bench(config: DictConfig) -> None:
        from hydra.core.hydra_config import HydraConfig

        folder = Path(HydraConfig.get().runtime.output_dir)
        importlib.import_module(f"gsgan.bench.{name}").run(config, folder)

    entry(f"bench_{name}")(bench)()


if __name__ == "__main__":
    main()
