"""``python -m gsgan.bench <subject> [key=value]``: measure what things cost."""

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
    "stability": "the float32 error of every hard case",
    "rays": "what anti-aliasing of the default person costs, and the noise without it",
    "fit": "how much noise in the landmarks their fit to the masks takes away",
    "loader": "training pictures a second from disk",
    "speed": "milliseconds from skeleton to picture, by stage",
    "trade-off": "quality against time and memory, over settings and small trainings",
    "effects": "what each effect gains where it is called for, and costs (trains for an hour)",
}
HELP = ("-h", "--help")


def split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """The subject, which is the first word that is no option or override, and the rest."""
    for i, word in enumerate(arguments):
        if "=" not in word and not word.startswith(("-", "+", "~")):
            return word, [*arguments[:i], *arguments[i + 1 :]]
    return None, list(arguments)


def subjects() -> str:
    """One line a subject."""
    lines = [f"  {name:<10} {what}" for name, what in SUBJECTS.items()]
    return "\n".join(["python -m gsgan.bench <subject> [key=value], subjects:", *lines])


def module_name(subject: str) -> str:
    """Of its module, and after ``bench_`` of its config."""
    return subject.replace("-", "_")


def main() -> None:
    """Hands the command line, less the subject, to Hydra."""
    subject, rest = split(sys.argv[1:])
    if subject is None and any(word in HELP for word in rest):
        print(subjects())
        print("Each answers --help with its whole config.")
        return
    if subject not in SUBJECTS:
        known = ", ".join(SUBJECTS)
        came = "nothing was given" if subject is None else f"{subject!r} is none"
        sentence = f"gsgan: the first word must be a subject ({known}); {came}"
        Console(stderr=True, soft_wrap=True).print(
            sentence, style="bold red", markup=False, highlight=False
        )
        sys.exit(FAILED)
    sys.argv = [sys.argv[0], *rest]
    name = module_name(subject)

    def bench(config: DictConfig) -> None:
        from hydra.core.hydra_config import HydraConfig

        folder = Path(HydraConfig.get().runtime.output_dir)
        importlib.import_module(f"gsgan.bench.{name}").run(config, folder)

    entry(f"bench_{name}")(bench)()


if __name__ == "__main__":
    main()
