"""Starts the MediaPipe tool in its own environment, which is made when asked."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gsgan.prepare.sources import Source
from gsgan.prepare.writing import writing
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import cache_root

TOOL = Path(__file__).parent / "mediapipe_tool"
SCRIPT, REQUIREMENTS = TOOL / "detect.py", TOOL / "requirements.txt"
NEWEST = (3, 12)  # the pinned MediaPipe has no build for later Pythons
MARKER = ".gsgan-mediapipe"  # written first: a folder with it is ours to make again
READY = ".ready"  # written last: an environment without it is half made


@dataclass(frozen=True)
class MediaPipe:
    """The landmark tool and its environment.

    Args:
        folder: of the environment; None for one in the user's cache.
        python: that makes it, 3.11 or 3.12; None for this one, or one on the PATH.
        threads: processors a camera's detector may use; 0 for all.
        confidence: least score for a person to be found.
        tracking: least score for a person to be followed to the next picture.
        margin: how far beyond the joints the mask is looked for, in shares of the person's height.

    Raises:
        ConfigError: when a value is out of its range.
    """

    folder: str | None = None
    python: str | None = None
    threads: int = 1
    confidence: float = 0.5
    tracking: float = 0.5
    margin: float = 0.15

    def __post_init__(self) -> None:
        if not (0 <= self.confidence <= 1 and 0 <= self.tracking <= 1 and self.margin >= 0):
            raise ConfigError(
                "mediapipe.confidence and .tracking must be 0 to 1 and .margin at least 0, got "
                f"{self.confidence!r}, {self.tracking!r} and {self.margin!r}"
            )

    @property
    def environment(self) -> Path:
        """Where the environment lies or will lie."""
        if self.folder is not None:
            return Path(self.folder).expanduser()
        return cache_root() / "tools" / "mediapipe-0.10.21"

    @property
    def key(self) -> dict[str, object]:
        """What the detections depend on."""
        return {
            "script": SCRIPT.read_text(),
            "requirements": REQUIREMENTS.read_text(),
            "confidence": self.confidence,
            "tracking": self.tracking,
            "margin": self.margin,
        }


def ensure_environment(tool: MediaPipe, setup: bool, say: Callable[[str], None]) -> Path:
    """The environment's Python; when it is missing, it is made if ``setup`` allows it.

    Raises:
        ConfigError: when it is missing and may not be made, its folder holds something else, or no
            fitting Python is there.
        DataError: when it cannot be made.
    """
    place = tool.environment
    python = place / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    if (place / READY).is_file() and python.exists():
        return python
    if not setup:
        raise ConfigError(
            f"landmarks=mediapipe needs its own environment at {place}, which is not there; add "
            "setup=true to make it (some 400 MB are installed), or give landmarks=<folder> and "
            "masks=<folder>"
        )
    base = _base_python(tool.python)
    _claim(place)
    say(f"making the MediaPipe environment at {place}, once")
    _run([base, "-m", "venv", str(place)], "the environment cannot be made")
    install = [str(python), "-m", "pip", "install", "--quiet", "--no-deps"]
    install += ["--disable-pip-version-check", "-r", str(REQUIREMENTS)]
    _run(install, "pip cannot install MediaPipe")
    _run([str(python), str(SCRIPT), "--help"], "MediaPipe does not start")
    with writing(place):
        (place / READY).touch()
    return python


def _claim(place: Path) -> None:
    """An empty folder with our marker; only an empty or half-made environment is taken away."""
    with writing(place):
        if place.exists():
            if any(place.iterdir()) and not (place / MARKER).is_file():
                raise ConfigError(
                    f"mediapipe.folder={place} holds something else than an environment that gsgan "
                    "made; give a new or empty folder"
                )
            shutil.rmtree(place)
        place.mkdir(parents=True)
        (place / MARKER).touch()


def _base_python(given: str | None) -> str:
    if given is not None:
        return given
    if sys.version_info[:2] <= NEWEST:
        return sys.executable
    for minor in (12, 11):
        if found := shutil.which(f"python3.{minor}"):
            return found
    raise ConfigError(
        "MediaPipe 0.10.21 needs Python 3.11 or 3.12, and neither is on the PATH; install one and "
        "give mediapipe.python=/path/to/python3.12"
    )


def _run(command: list[str], what: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise DataError(f"{what}: {command[0]} cannot be started ({error.strerror})") from None
    if done.returncode:
        raise DataError(f"{what}: {_last_line(done.stderr or done.stdout)}")


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "it ended without a word"


def detect(
    tool: MediaPipe,
    python: Path,
    source: Source,
    out: Path,
    *,
    hands: bool,
    masks: Path | None,
    slot: int,
    advance: Callable[[int, int], None],
) -> None:
    """Finds landmarks (and masks) in one source.

    Args:
        tool: its settings.
        python: of its environment.
        source: the pictures.
        out: npz to write, whole or not at all.
        hands: find the hands too.
        masks: folder for the masks, or None.
        slot: number among those that run at once: each takes processors of its own.
        advance: called with pictures done and in all.

    Raises:
        DataError: when the tool fails, with the last line that it said.
    """
    command = [str(python), str(SCRIPT), "--source", str(source.path), "--out", str(out)]
    command += ["--hands", str(int(hands)), "--rotate", str(int(source.rotate))]
    command += ["--threads", str(tool.threads), "--slot", str(slot)]
    command += ["--confidence", str(tool.confidence), "--tracking", str(tool.tracking)]
    command += ["--margin", str(tool.margin)]
    if masks is not None:
        command += ["--masks", str(masks)]
    with (
        tempfile.TemporaryFile("w+") as complaints,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=complaints, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                done, _, count = line.partition(" ")
                if done.isdigit() and count.strip().isdigit():
                    advance(int(done), int(count))
        except BaseException:
            process.kill()
            raise
        if process.wait():
            complaints.seek(0)
            raise DataError(
                f"{source.path}: the MediaPipe tool failed: {_last_line(complaints.read())}"
            )
