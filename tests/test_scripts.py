"""Scripts of docs/reliability.md, small: each ends with an error where a promise fails."""

import importlib
import subprocess
import sys

import numpy as np
import pytest
from commands import ENVIRONMENT, ROOT

from gsgan.synthetic.scene_setup import load_character
from gsgan.synthetic.takes import MOTIONS


@pytest.mark.parametrize(
    "words",
    [
        (
            "big_data",
            "--frames=200",
            "--cameras=2",
            "--reads=160",
            "--workers=1",
        ),
        pytest.param(
            ("sweeps", "joblib", "--runs=4", "--kills=1"),
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda words: words[0],
)
def test_a_script_ends_well(words, tmp_path):
    command = [
        sys.executable,
        str(ROOT / "scripts" / f"{words[0]}.py"),
        *words[1:],
    ]
    done = subprocess.run(
        command,
        env=ENVIRONMENT,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_print_changes_the_colours_in_its_box_and_no_shape(tmp_path):
    source = ROOT / "src" / "gsgan" / "synthetic" / "avatars" / "polo.glb"
    target = tmp_path / "printed.glb"
    script = str(ROOT / "scripts" / "print_clothes.py")
    box = "0,0,0.5,1"  # the left half of the texture
    command = [sys.executable, script, str(source), str(target), box]
    subprocess.run(command, env=ENVIRONMENT, cwd=tmp_path, check=True)
    before = load_character(str(source))
    after = load_character(str(target))
    assert np.array_equal(before.vertices, after.vertices)
    old = before.surfaces[0].colour.astype(int)
    new = after.surfaces[0].colour.astype(int)
    half = old.shape[1] // 2
    changed = (
        np.abs(new - old).max(axis=-1) > 60
    )  # more than compressing it again does
    assert changed[:, :half].mean() > 0.01
    assert changed[:, half:].mean() < 0.001


@pytest.fixture
def bake(monkeypatch):
    """The module scripts/bake_motions.py."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    return importlib.import_module("bake_motions")


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("avatar", ["polo", "blouse"])
def test_the_motions_are_those_of_their_generator(bake, name, avatar):
    programme = bake.PROGRAMMES[name]
    subject = bake.Subject(load_character(avatar), programme)
    times = np.random.default_rng(0).uniform(0, programme.duration, 40)
    assert subject.error(MOTIONS[name], times).max() < 3e-4


@pytest.mark.slow
def test_a_motion_can_be_baked_again(bake, tmp_path):
    bake.bake("signs", tmp_path, 0.01)
    subject = bake.Subject(load_character("polo"), bake.PROGRAMMES["signs"])
    times = np.linspace(0, 24, 40)
    assert 1e-4 < subject.error(tmp_path / "signs.npz", times).max() < 0.01
