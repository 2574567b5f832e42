"""The hard cases on instruction sets this machine would not choose: kernels round differently."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PORTABLE = {"ATEN_CPU_CAPABILITY": "default", "GSGAN_MARCH": "x86-64"}
AVX2 = {"ATEN_CPU_CAPABILITY": "avx2", "GSGAN_MARCH": "x86-64-v3"}


def run_suite(environment: dict[str, str], *arguments: str) -> None:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        *arguments,
    ]
    done = subprocess.run(
        command,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment", [PORTABLE, AVX2], ids=["portable", "avx2"]
)
def test_every_case(environment):
    run_suite(environment, str(HERE), "--ignore", __file__)
