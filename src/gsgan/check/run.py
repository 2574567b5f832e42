"""A whole check: one pass over the data, every question asked, one report."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.progress import track

from gsgan.check.findings import Report
from gsgan.check.looking import Broken, Look, chosen_items, look_at
from gsgan.check.sections import failed, sections
from gsgan.check.settings import Limits, Sampling
from gsgan.check.subject import subject_of
from gsgan.check.suspects import suspicious
from gsgan.effects import EffectSettings
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import write_atomically

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

Progress = Callable[[Iterable[Look | Broken], int], Iterable[Look | Broken]]


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
        sampling: how much is looked at.
        limits: from where on something is wrong.
        progress: wraps the results of the pass over the pictures, given their number.
        effects: what training would be asked of the effects; None: the defaults.

    Returns:
        The report; a dataset that cannot be read gives one with the reader's sentence.

    Raises:
        ConfigError: when the data's config is wrong.
    """
    try:
        subject = subject_of(data)
    except DataError as error:
        return failed(data.root, error)
    items = chosen_items(subject, sampling.pictures)
    items = tuple(dict.fromkeys((*items, *suspicious(subject, sampling))))
    looks, broken = look_at(subject, items, limits, sampling, progress)
    asked = effects or EffectSettings()
    return sections(data, subject, looks, broken, sampling, limits, asked)


def run_check(config: DictConfig) -> Report:
    """Checks the dataset of a config, prints the report and writes it as HTML and JSON.

    Raises:
        ConfigError: on a config value that does not fit.
    """
    # imported here: the page and the terminal are needed by commands only
    from gsgan.check.page import page
    from gsgan.check.terminal import print_report

    if not config.report:
        raise ConfigError("report is not set: give the HTML file to write, e.g. report=check.html")
    # the reader's notes have their place in the report
    logging.getLogger("gsgan.data").setLevel(logging.ERROR)
    console = make_console()
    sampling: Sampling = instantiate(config.sampling)
    limits: Limits = instantiate(config.limits)

    def shown(results: Iterable[Look | Broken], count: int) -> Iterable[Look | Broken]:
        told = "looking at pictures"
        return track(results, told, count, console=console, transient=True)

    report = _checked(config, sampling, limits, shown)
    path = Path(config.report).expanduser()
    try:
        write_atomically(path, page(report))
        write_atomically(
            path.with_suffix(".json"), json.dumps(plain(report), indent=1, allow_nan=False) + "\n"
        )
    except OSError as error:
        raise ConfigError(f"report={path} cannot be written: {error.strerror}") from None
    print_report(report, console)
    console.print(f"report: {path}", markup=False, highlight=False, soft_wrap=True)
    return report


def _checked(config: DictConfig, sampling: Sampling, limits: Limits, progress: Progress) -> Report:
    try:
        data = instantiate(config.data)
    except InstantiationException as error:
        if isinstance(error.__cause__, DataError):
            return failed(config.data.get("root"), error.__cause__)
        raise
    return check_data(data, sampling, limits, progress, instantiate(config.effects))


def plain(report: Report) -> dict[str, Any]:
    """The report's findings and numbers for a machine; null stands for what is not known."""
    return {
        "root": report.root,
        "errors": report.errors,
        "warnings": report.warnings,
        "findings": [
            {"level": f.level, "topic": f.topic, "sentence": f.sentence} for f in report.findings
        ],
        **{key: _known(value) for key, value in report.numbers.items()},
    }


def _known(value: Any) -> Any:
    """A value without NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _known(held) for key, held in value.items()}
    if isinstance(value, (list, tuple)):
        return [_known(held) for held in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
