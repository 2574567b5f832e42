"""A whole check: one pass over the data, all measurements, one report."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from omegaconf import DictConfig
from rich.console import Console

from gsgan.check.report import CheckReport, Finding, Section, page, print_report
from gsgan.check.sections import Measurements, sections
from gsgan.check.settings import Limits, Sampling
from gsgan.data.formats.capture import CaptureReader, capture_problems
from gsgan.effects import EffectSettings
from gsgan.utils.checks import one_of
from gsgan.utils.config import FAILED, CommandOptions, build, defaults_of
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import write_atomically, write_json, writing

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData


def check_data(
    data: GsganData,
    sampling: Sampling,
    limits: Limits,
    effects: EffectSettings,
    console: Console | None = None,
) -> CheckReport:
    """Checks a dataset.

    Args:
        data: it need not have been read yet.
        sampling: how much is checked.
        limits: thresholds.
        effects: settings of the effects as for training.
        console: shows the progress.

    Returns:
        The report; if a dataset cannot be read, it has the reader's message.

    Raises:
        ConfigError: when the data's config is wrong.
    """
    # A dataset that cannot be read has a report, too.
    try:
        measured = Measurements(data, sampling, limits, effects, console)
    except DataError as error:
        # The reader stops at the first problem; captures are searched for all.
        messages = [str(error)]
        folder = Path(str(data.root)).expanduser()
        if isinstance(data.reader, CaptureReader) and folder.is_dir():
            messages += capture_problems(folder, data.limits, messages)
        return unreadable(data.root, messages)
    return CheckReport(
        str(measured.subject.layout.root),
        sections(measured),
        measured.numbers(),
    )


def unreadable(root: str | None, messages: Sequence[str]) -> CheckReport:
    """The report of a dataset that the reader refuses, with every reason that was found."""
    reasons = dict.fromkeys(messages)  # each once, in their order
    findings = [Finding("error", "reading", reason) for reason in reasons]
    section = Section(
        "The dataset cannot be read",
        findings=findings,
        text="Nothing further could be checked. Correct this, then check again.",
    )
    return CheckReport(str(root), (section,), {"readable": False})


def check_capture(root: Path, path: Path, console: Console) -> CheckReport:
    """Checks a capture with the default settings, see `write_report`."""
    from gsgan.data.datamodule import GsganData

    data = GsganData(root=str(root), reader=CaptureReader())
    defaults = defaults_of("check")
    report = check_data(
        data,
        sampling=build(defaults.sampling),
        limits=build(defaults.limits),
        effects=build(defaults_of("effects/auto")),
        console=console,
    )
    write_report(report, path, console)
    return report


@dataclass(frozen=True)
class CheckOptions(CommandOptions):
    """The options of gsgan.check: conf/check.yaml.

    Args:
        data: it need not have been read yet; or why it cannot be made.
        report: the HTML file.
        strict: whether a warning ends the command with 1, too.
        sampling, limits, effects: as for `check_data`.
    """

    data: GsganData | CheckReport
    report: str | None
    strict: bool
    sampling: Sampling
    limits: Limits
    effects: EffectSettings

    @classmethod
    def from_config(cls, config: DictConfig) -> Self:
        """The options of a config; a dataset that cannot be made has a report, too."""
        names = ("report", "strict", "sampling", "limits", "effects")
        values = {name: build(config[name]) for name in names}
        try:
            values["data"] = build(config.data)
        except DataError as error:
            values["data"] = unreadable(config.data.get("root"), [str(error)])
        return cls(**values)


def check(options: CheckOptions) -> None:
    """Checks a dataset, prints and writes a report; ends with 1 when something is wrong.

    Raises:
        ConfigError: on a value that does not fit.
    """
    one_of("strict", options.strict, (True, False))
    # The report is the result of the command, so it must have a place.
    if not options.report:
        raise ConfigError(
            "report is not set: give the HTML file to write, e.g. report=check.html"
        )
    # The reader's notes are part of the report.
    logging.getLogger("gsgan.data").setLevel(logging.ERROR)
    console = make_console()
    report = options.data
    if not isinstance(report, CheckReport):
        report = check_data(
            report, options.sampling, options.limits, options.effects, console
        )
    write_report(report, Path(options.report).expanduser(), console)
    if report.errors or (options.strict and report.warnings):
        sys.exit(FAILED)


def write_report(report: CheckReport, path: Path, console: Console) -> None:
    """Prints a report, and writes it as HTML and its numbers beside it as JSON.

    Raises:
        DataError: when a file cannot be written.
    """
    # The content of the JSON file.
    content = {
        "root": report.root,
        "errors": report.errors,
        "warnings": report.warnings,
        "findings": [asdict(finding) for finding in report.findings],
        **report.numbers,
    }

    # The page, the numbers next to it, then the terminal.
    with writing(path):
        write_atomically(path, page(report))
    write_json(path.with_suffix(".json"), content)
    print_report(report, console)
    console.print(
        f"report: {path}", markup=False, highlight=False, soft_wrap=True
    )
