"""The compiler, the cache and the loading of the kernel, and the reasons why it may be missing."""

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from gsgan.splat import build, native

needs_kernel = pytest.mark.skipif(
    not native.available(), reason=native.why_not() or "available"
)

REPORT = "from gsgan.splat import native; print(native.available(), native.why_not(), sep='|')"


def report(cache: Path, **environment: str) -> tuple[bool, str]:
    """available() and why_not() of a fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", REPORT],
        env={
            **os.environ,
            "GSGAN_CACHE": str(cache),
            "OMP_NUM_THREADS": "1",
            **environment,
        },
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    yes, _, reason = done.stdout.strip().partition("|")
    return yes == "True", reason


@pytest.fixture
def load_afresh(monkeypatch):
    """available() and why_not() as in a fresh process."""

    def load(cache: Path, **environment: str) -> tuple[bool, str]:
        monkeypatch.setenv("GSGAN_CACHE", str(cache))
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        library, reason = build._load_once.__wrapped__()
        return library is not None, reason

    return load


@pytest.mark.parametrize(
    ("environment", "word"),
    [
        ({"CXX": "/bin/false", "PATH": ""}, "/bin/false"),
        ({"CXX": "", "PATH": "/nowhere"}, "No C++ compiler is found"),
        ({"CXX": "{fake}"}, "no luck"),
        (
            {"GSGAN_CACHE": "{fake}"},
            "GSGAN_CACHE",
        ),  # no folder: it cannot be written
    ],
)
def test_what_cannot_be_built_is_one_sentence(
    tmp_path, load_afresh, environment, word
):
    # Answers --version like a compiler, then fails with a message.
    fake = tmp_path / "fake"
    fake.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && exit 0\necho "x.cpp:1: error: no luck" >&2\nexit 1\n'
    )
    fake.chmod(0o755)
    given = {
        name: value.format(fake=fake) for name, value in environment.items()
    }
    yes, reason = load_afresh(tmp_path / "cache", **given)
    assert not yes
    assert word in reason
    assert reason[:1].isupper()
    assert reason.endswith(".")
    assert "\n" not in reason
    assert not [
        path for path in (tmp_path / "cache").rglob("*") if path.is_file()
    ]


@pytest.fixture(scope="module")
def quick_compiler(tmp_path_factory):
    """A compiler that compiles this one program, has no OpenMP, and takes ``SLOW`` seconds."""
    folder = tmp_path_factory.mktemp("compiler")
    library = shutil.copy(build.library()[0]._name, folder)
    fake = folder / "fake"
    fake.write_text(
        "#!/bin/sh\n"
        'for f in "$@"; do\n'
        '  [ "$f" = --version ] && exit 0\n'
        '  [ "$f" = -fopenmp ] && exit 1\n'
        '  last="$f"\n'
        "done\n"
        f"sleep ${{SLOW:-0}}; cp {library} $last\n"
    )
    fake.chmod(0o755)
    return fake


@needs_kernel
def test_builds_without_openmp(tmp_path, quick_compiler, load_afresh):
    assert load_afresh(tmp_path, CXX=str(quick_compiler)) == (True, "")


@pytest.mark.slow
@needs_kernel
def test_one_thread_without_openmp(tmp_path):
    command = [
        *build.compiler(),
        *build.BASE_FLAGS,
        str(build.SOURCE),
        "-o",
        f"{tmp_path}/x.so",
    ]
    assert subprocess.run(command, check=False).returncode == 0
    library = build.open_library(tmp_path / "x.so")
    assert library is not None
    assert library.gsgan_has_openmp() == 0


@pytest.mark.slow
@needs_kernel
def test_two_processes_build_at_once(tmp_path, quick_compiler):
    answers: list[tuple[bool, str]] = []

    def build() -> None:
        answers.append(report(tmp_path, CXX=str(quick_compiler), SLOW="2"))

    builders = [threading.Thread(target=build) for _ in range(2)]
    for builder in builders:
        builder.start()
    for builder in builders:
        builder.join()
    assert answers == [(True, ""), (True, "")]
    assert len(list((tmp_path / "native").iterdir())) == 1


@needs_kernel
def test_without_a_compiler_the_kernels_of_the_wheel_are_loaded(
    tmp_path, monkeypatch, load_afresh
):
    # The compiled library of this machine stands for the wheel's.
    load_afresh(tmp_path)
    (library,) = (tmp_path / "native").glob("*.so")
    monkeypatch.setattr(build, "PACKAGED", library)
    assert load_afresh(tmp_path / "other", CXX="/nowhere") == (True, "")

    # A processor without the wheel's instructions does not load it.
    monkeypatch.setattr(build.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(
        "torch.backends.cpu.get_cpu_capability", lambda: "DEFAULT"
    )
    found, reason = load_afresh(tmp_path / "other", CXX="/nowhere")
    assert not found
    assert "/nowhere" in reason


@pytest.mark.slow
def test_a_wheel_with_kernels_has_the_platforms_name_and_every_function(
    tmp_path,
):
    subprocess.run(
        [
            sys.executable,
            "-m",
            "build",
            "--wheel",
            "--outdir",
            str(tmp_path),
            str(Path(__file__).parents[2]),
        ],
        env={**os.environ, "GSGAN_WHEEL_KERNELS": "1"},
        check=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.startswith("gsgan-")
    assert "-py3-none-linux_" in wheel.name
    shutil.unpack_archive(wheel, tmp_path / "wheel", "zip")
    library = tmp_path / "wheel" / "gsgan" / "splat" / "prebuilt.so"
    assert build.open_library(library) is not None
