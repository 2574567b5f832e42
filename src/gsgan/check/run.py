"""A whole check: one pass over the data, all measurements, one report."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.progress import track

from gsgan.check.contents import unreadable
from gsgan.check.report import Report, page, print_report
from gsgan.check.sections import Measured, sections
from gsgan.check.settings import Limits, Sampling
from gsgan.check.views import Results, measure, sampled_items, subject_of, suspicious_items
from gsgan.effects import EffectSettings
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import write_atomically

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

Progress = Callable[[Results, int], Results]


def check_data(
    data: GsganData,
    sampling: Sampling,
    limits: Limits,
    progress: Progress | None = None,
    effects: EffectSettings | None = None,
) -> Report:
    """Checks a dataset.

    Args:
        data: it need not have been read yet.
        sampling: how much is checked.
        limits: thresholds.
        progress: wraps the results of the pass over the images, given their number.
        effects: settings of the effects as for training; None: the defaults.

    Returns:
        The report; of a dataset that cannot be read it has the reader's message.

    Raises:
        ConfigError: when the data's config is wrong.
    """
    try:
        subject = subject_of(data)
    except DataError as error:
        return _failed(data.root, error)
    items = (*sampled_items(subject, sampling.pictures), *suspicious_items(subject, sampling))
    views, broken = measure(subject, tuple(dict.fromkeys(items)), sampling, progress)
    measured = Measured(data, subject, views, broken, sampling, limits, effects or EffectSettings())
    return Report(str(subject.layout.root), sections(measured), measured.numbers())


def _failed(root: str | None, error: DataError) -> Report:
    return Report(str(root), (unreadable(root, error),), {"readable": False})


def run_check(config: DictConfig) -> Report:
    """Checks the dataset of a config, prints the report and writes it as HTML and JSON.

    Raises:
        ConfigError: on a config value that does not fit.
    """
    if not config.report:
        raise ConfigError("report is not set: give the HTML file to write, e.g. report=check.html")
    # the reader's notes are part of the report
    logging.getLogger("gsgan.data").setLevel(logging.ERROR)
    console = make_console()
    sampling, limits = instantiate(config.sampling), instantiate(config.limits)

    def shown(results: Results, count: int) -> Results:
        return track(results, "checking images", count, console=console, transient=True)

    try:
        data = instantiate(config.data)
        report = check_data(data, sampling, limits, shown, instantiate(config.effects))
    except InstantiationException as error:
        if not isinstance(error.__cause__, DataError):
            raise
        report = _failed(config.data.get("root"), error.__cause__)
    path = Path(config.report).expanduser()
    numbers = json.dumps(plain(report), indent=1, allow_nan=False) + "\n"
    try:
        write_atomically(path, page(report))
        write_atomically(path.with_suffix(".json"), numbers)
    except OSError as error:
        raise ConfigError(f"report={path} cannot be written: {error.strerror}") from None
    print_report(report, console)
    console.print(f"report: {path}", markup=False, highlight=False, soft_wrap=True)
    return report


def plain(report: Report) -> dict[str, Any]:
    """The report's findings and numbers for the JSON file; null stands for unknown."""
    return {
        "root": report.root,
        "errors": report.errors,
        "warnings": report.warnings,
        "findings": [asdict(finding) for finding in report.findings],
        **{key: _known(value) for key, value in report.numbers.items()},
    }


def _known(value: Any) -> Any:
    """A value without NaN and infinity, which JSON lacks."""
    if isinstance(value, dict):
        return {key: _known(held) for key, held in value.items()}
    if isinstance(value, (list, tuple)):
        return [_known(held) for held in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
