"""Scripts of docs/reliability.md, small: each ends with an error where a promise fails."""

import subprocess
import sys

import pytest
from commands import ENVIRONMENT, ROOT


@pytest.mark.parametrize(
    "words",
    [
        ("big_data", "--frames=200", "--cameras=2", "--reads=160"),
        pytest.param(
            ("sweeps", "joblib", "--runs=4", "--kills=1"), marks=pytest.mark.slow
        ),
    ],
    ids=lambda words: words[0],
)
def test_a_script_ends_well(words, tmp_path):
    command = [sys.executable, str(ROOT / "scripts" / f"{words[0]}.py"), *words[1:]]
    done = subprocess.run(
        command,
        env=ENVIRONMENT,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
