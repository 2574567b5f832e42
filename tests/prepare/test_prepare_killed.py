"""A process killed (SIGKILL) at any stage: the next run makes the same dataset."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from capture_scenes import options, quiet, write_project

from gsgan.data.formats.capture import read_capture
from gsgan.prepare.run import prepare
from gsgan.prepare.stages import each_camera

LIMIT = 120  # seconds after which the child counts as hanging
pytestmark = pytest.mark.skipif(
    not hasattr(os, "fork"), reason="no fork, no child to kill"
)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    return write_project(
        tmp_path_factory.mktemp("killed") / "project", 3, 4, (64, 48)
    )


def killed(
    run: Callable[[], object], stop: Callable[[Path, int], bool]
) -> bool:
    """Whether a child that runs this was killed, at the first file for which ``stop`` says so.

    It dies as an image is to be written, or another file, written under another name, is to take
    its place; ``stop`` gets that place and how many files came before.
    """
    child = os.fork()
    if child == 0:
        signal.alarm(LIMIT)
        cv2.setNumThreads(0)
        replace, write, before = os.replace, Path.write_bytes, list[Path]()

        def step(target: Path) -> None:
            if stop(target, len(before)):
                os.kill(os.getpid(), signal.SIGKILL)
            before.append(target)

        def replacing(source, target) -> None:
            step(Path(target))
            replace(source, target)

        def writing(path: Path, data: bytes) -> int:
            step(path)
            return write(path, data)

        os.replace, Path.write_bytes = replacing, writing
        try:
            run()
        finally:
            os._exit(3)  # it finished, or failed
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL


def images(out: Path) -> dict[str, bytes]:
    paths = sorted((out / "images").rglob("*")) + sorted(
        (out / "masks").rglob("*")
    )
    return {
        str(p.relative_to(out)): p.read_bytes() for p in paths if p.is_file()
    }


STAGES: dict[str, Callable[[Path, int], bool]] = {
    "a mask, its image written": lambda place, n: (
        "masks" in place.parts and n > 8
    ),
    "the numbers": lambda place, _: place.name == "prepare.json",
    "the whole dataset": lambda place, _: place.name == "out",
}


@pytest.fixture(scope="module")
def whole(project):
    """The images of an undisturbed run."""
    given = options(project, out=str(project.parent / "undisturbed"), workers=1)
    return images(prepare(given, quiet()))


@pytest.mark.parametrize("stage", STAGES)
def test_a_killed_process_leaves_nothing_incomplete_and_is_resumed(
    project, whole, tmp_path, stage
):
    out = tmp_path / "out"
    given = options(project, out=str(out), workers=1)
    assert killed(lambda: prepare(given, quiet()), STAGES[stage])
    assert not out.exists()
    assert prepare(given, quiet()) == out
    assert images(out) == whole
    assert [p for p in out.rglob("*") if p.name.endswith(".part")] == []
    assert len(read_capture(out).frames) == 4


def test_an_earlier_dataset_outlives_a_kill(project, whole, tmp_path):
    out = tmp_path / "out"
    prepare(options(project, out=str(out), workers=1, frames="0-2"), quiet())
    again = options(project, out=str(out), workers=1, overwrite=True)
    assert killed(lambda: prepare(again, quiet()), STAGES["the numbers"])
    assert len(read_capture(out).frames) == 3  # the earlier one is still there
    assert killed(
        lambda: prepare(again, quiet()), lambda place, _: place == out
    )
    assert (
        len(read_capture(tmp_path / ".out.old").frames) == 3
    )  # moved aside, not lost
    prepare(again, quiet())
    assert images(out) == whole
    assert not (tmp_path / ".out.old").exists()


def test_a_failure_or_an_interrupt_stops_the_other_cameras():
    steps: list[int] = []

    def work(name: str, report: Callable[[int, int], None]) -> None:
        if name == "a":
            while not steps:
                time.sleep(0.001)
            raise KeyboardInterrupt
        for step in range(10**6):
            report(step, 10**6)
            steps.append(step)
            time.sleep(0.001)

    with pytest.raises(KeyboardInterrupt):
        each_camera(work, "working", ["a", "b", "c"], 2)
    assert 0 < len(steps) < 10**4
