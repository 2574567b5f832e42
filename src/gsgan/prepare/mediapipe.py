"""The MediaPipe tool: its environment, and running it on every camera."""

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from filelock import FileLock

from gsgan.prepare.images import find_masks
from gsgan.prepare.landmarks import find_landmarks
from gsgan.prepare.options import MEDIAPIPE, MediaPipe, Options
from gsgan.prepare.sources import Recording
from gsgan.prepare.stages import Advance, StageFolder, each_camera
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import cache_root, writing

TOOL = Path(__file__).parent / "mediapipe_tool"
SCRIPT = TOOL / "detect.py"
REQUIREMENTS = TOOL / "requirements.txt"
NEWEST = (3, 12)  # the pinned MediaPipe has no build for later Pythons
# Written first: a folder with it was made here and may be replaced.
MARKER = ".gsgan-mediapipe"
READY = ".ready"  # written last: an environment without it is incomplete


def environment_of(tool: MediaPipe) -> Path:
    """The environment's folder, which need not exist."""
    usual = cache_root() / "tools" / "mediapipe-0.10.21"
    return Path(tool.folder or usual).expanduser()


def tool_key() -> list[str]:
    """The files on which the detections depend."""
    return [SCRIPT.read_text(), REQUIREMENTS.read_text()]


class People(NamedTuple):
    """Files by source."""

    landmarks: dict[str, Path]
    masks: dict[str, dict[int, Path]]  # by frame number


def find_people(
    options: Options,
    sources: Mapping[str, Recording],
    stages: StageFolder,
    say: Callable[[str], None],
) -> People:
    """Landmarks and masks of each source: given ones, or those of the tool."""
    people = People({}, {})
    if options.needs_tool:
        people = run_tool(options, sources, stages, say)
    if options.masks != MEDIAPIPE:
        masks = find_masks(options.folder("masks"), sources)
        people = people._replace(masks=masks)
    if options.landmarks != MEDIAPIPE:
        landmarks = find_landmarks(options.folder("landmarks"), sources)
        people = people._replace(landmarks=landmarks)
    return people


def run_tool(
    options: Options,
    sources: Mapping[str, Recording],
    stages: StageFolder,
    say: Callable[[str], None],
) -> People:
    """Landmarks and masks of each source by MediaPipe.

    The tool runs for sources whose results are not stored.

    Raises:
        ConfigError: when the environment is missing and may not be created.
        DataError: when the tool fails or finds nobody in a source.
    """
    tool = options.mediapipe
    masks = options.masks == MEDIAPIPE
    parts = {"hands": options.hands, "face": options.face}

    # Results depend on the images, the tool, and the parts that it looks for.
    results = {}
    folders = {}
    for name, source in sources.items():
        key = [source.fingerprint(), source.rotate, tool_key(), parts, masks]
        if options.person is not None:
            key.append(list(options.person))
        folders[name] = stages.path(f"mediapipe-{name}", key)
        results[name] = folders[name].with_suffix(".npz")

    # The npz is written last: if it exists, the masks are complete too.
    missing = [name for name in sources if not results[name].is_file()]
    if missing:
        python = ensure_environment(tool, options.setup, say)

        def one(name: str, advance: Advance) -> None:
            # The tool has its own environment, so everything goes through the
            # command line.
            given = {
                "source": str(sources[name].path),
                "out": str(results[name]),
                "masks": str(folders[name]) if masks else "",
                **parts,
                "rotate": sources[name].rotate,
                "person": options.person and list(options.person),
                "slot": missing.index(name) % options.workers,
                "threads": tool.threads,
            }
            command = [str(python), str(SCRIPT), json.dumps(given)]
            _detect(command, sources[name].path, advance)

        each_camera(one, "finding landmarks", missing, options.workers)

    # The masks; a source without any shows nobody.
    landmark_files = {}
    for name, folder in folders.items():
        files = sorted(folder.glob("*.png"))
        if masks and not files:
            raise DataError(
                f"MediaPipe found nobody in {name}; show a person, or leave it out"
            )
        landmark_files[name] = {int(path.stem): path for path in files}
    return People(results, landmark_files)


def _detect(command: list[str], source: Path, advance: Advance) -> None:
    """Runs the tool, which prints lines "<done> <count>"."""
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process,
    ):
        # A line of progress for each image; an interrupt ends the tool too.
        try:
            assert process.stdout is not None
            for line in process.stdout:
                # Other lines are MediaPipe's own messages.
                done, _, count = line.partition(" ")
                if done.isdigit() and count.strip().isdigit():
                    advance(int(done), int(count))
        except BaseException:
            process.kill()
            raise

        # The tool's last line of errors is the reason of its failure.
        if process.wait():
            errors.seek(0)
            raise DataError(
                f"{source}: the MediaPipe tool failed: {_last_line(errors.read())}"
            )


def ensure_environment(
    tool: MediaPipe,
    setup: bool,
    say: Callable[[str], None],
) -> Path:
    """The environment's Python; a missing environment is created if ``setup`` allows it.

    Raises:
        ConfigError: when it may not be created, its folder is in use, or no Python fits.
        DataError: when creating it fails.
    """
    place = environment_of(tool)
    python = place / (
        "Scripts/python.exe" if sys.platform == "win32" else "bin/python"
    )
    if (place / READY).is_file() and python.exists():
        return python
    if not setup:
        raise ConfigError(
            f"landmarks=mediapipe needs its own environment at {place}: add setup=true to create "
            "it (some 400 MB), or give landmarks=<folder> and masks=<folder>"
        )

    # A Python that MediaPipe supports.
    base = tool.python
    if not base and sys.version_info[:2] <= NEWEST:
        base = sys.executable
    base = base or shutil.which("python3.12") or shutil.which("python3.11")
    if base is None:
        raise ConfigError(
            "MediaPipe needs Python 3.11 or 3.12: set mediapipe.python=<path>"
        )

    # Two commands that start at once must not both write the folder.
    with writing(place):
        place.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(place.with_name(f".{place.name}.lock")):
            if not (place / READY).is_file():
                _create(place, base, python, say)
    return python


def _create(
    place: Path, base: str, python: Path, say: Callable[[str], None]
) -> None:
    """Creates the environment at ``place`` with ``base``, which becomes ``python``."""
    # The folder, marked as made here.
    with writing(place):
        if place.exists():
            if any(place.iterdir()) and not (place / MARKER).is_file():
                raise ConfigError(
                    f"mediapipe.folder={place} holds something else; give a new one"
                )
            shutil.rmtree(place)
        place.mkdir(parents=True)
        (place / MARKER).touch()

    # The environment, complete with its last file.
    say(f"creating the MediaPipe environment at {place}, once")
    _run([base, "-m", "venv", str(place)], "the environment cannot be created")
    install = [
        str(python),
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--disable-pip-version-check",
        "-r",
        str(REQUIREMENTS),
    ]
    _run(install, "pip cannot install MediaPipe")
    _run([str(python), "-c", "import mediapipe"], "MediaPipe does not start")
    with writing(place):
        (place / READY).touch()


def _run(command: list[str], what: str) -> None:
    """Runs a command; ``what`` begins the message if it fails."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise DataError(
            f"{what}: {command[0]} cannot be started ({error.strerror})"
        ) from None
    if done.returncode:
        raise DataError(f"{what}: {_last_line(done.stderr or done.stdout)}")


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it ended without a message"])[
        -1
    ].strip()
