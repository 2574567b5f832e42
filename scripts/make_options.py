"""Writes docs/options.md: every config file with its comments, so that no option goes undocumented.

Run after a change in conf/:  .venv/bin/python scripts/make_options.py  (--check only compares)
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "docs" / "options.md"
INTRO = """# Options

Made by `scripts/make_options.py` from `conf/`; a test keeps it up to date. Every key can be set on
the command line (`key=value`), every group's choice exchanged (`group=choice`), and a
comma-separated list with `-m` runs every combination. `python -m gsgan.train --help` prints the
same for the config as composed.
"""
ORDER = (
    "prepare",
    "check",
    "fit",
    "train",
    "evaluate",
    "report",
    "bench_raster",
    "bench_stability",
    "bench_rays",
    "bench_fit",
    "bench_loader",
    "bench_speed",
    "bench_trade_off",
    "bench_effects",
    "hydra_run",
    "hydra_help",
)


def page() -> str:
    """The whole page."""
    conf = ROOT / "conf"
    top = [conf / f"{name}.yaml" for name in ORDER]
    groups = sorted(path for path in conf.rglob("*.yaml") if path.parent != conf)
    parts = [INTRO]
    for path in [*top, *groups]:
        parts.append(f"## {path.relative_to(conf).with_suffix('')}\n")
        parts.append(f"```yaml\n{path.read_text().rstrip()}\n```\n")
    return "\n".join(parts)


def main() -> int:
    """Writes the page, or with --check says whether it is up to date."""
    if "--check" in sys.argv[1:]:
        return int(not TARGET.is_file() or TARGET.read_text() != page())
    TARGET.write_text(page())
    return 0


if __name__ == "__main__":
    sys.exit(main())
