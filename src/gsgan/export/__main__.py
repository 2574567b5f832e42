"""``python -m gsgan.export``: read what an image or video says about its origin."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from gsgan.utils.config import entry
from gsgan.utils.errors import ConfigError


def export(config: DictConfig) -> None:
    """Prints what ``config.verify`` says about its origin."""
    from gsgan.utils.console import make_console
    from gsgan.utils.provenance import verify

    if config.verify is None:
        raise ConfigError("verify is not set: give verify=<image or video>")
    path = Path(config.verify).expanduser()
    found, console = verify(path), make_console()
    state = "marked as synthetic" if found.synthetic else "not marked as synthetic"
    for line in (f"{path.name}: {state}", *found.lines()):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


main = entry("export")(export)

if __name__ == "__main__":
    main()
