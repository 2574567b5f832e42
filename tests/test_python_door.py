"""``import gsgan``: what it offers, what it loads, and the examples of docs/python.md."""

import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest
import yaml
from commands import ROOT

import gsgan
from gsgan.splat import ACCURACY, Accuracy

PAGE = (ROOT / "docs" / "python.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, flags=re.S)
HEAVY = (
    "hydra",
    "omegaconf",
    "rich",
    "kornia",
    "pandas",
    "lightning",
    "trimesh",
    "cv2",
)


@pytest.mark.parametrize("name", gsgan.__all__)
def test_every_name_is_offered_and_explained(name):
    assert getattr(gsgan, name).__name__ == name
    assert f"gsgan.{name}" in PAGE
    assert name in dir(gsgan)


def test_an_unknown_name_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = gsgan.nothing


def modules_after(statement: str) -> set[str]:
    """The packages that a fresh interpreter has loaded after a statement."""
    code = f"import sys; {statement}; print(*sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return {name.partition(".")[0] for name in result.stdout.split()}


def test_importing_the_rasteriser_loads_torch_alone():
    loaded = modules_after("import gsgan.splat")
    assert "torch" in loaded
    assert not loaded & set(HEAVY)


@pytest.mark.parametrize("name", ACCURACY)
def test_the_presets_are_those_of_conf(name):
    preset = yaml.safe_load((ROOT / f"conf/accuracy/{name}.yaml").read_text())
    del preset["_target_"]
    assert Accuracy(**preset) == ACCURACY[name]


def test_the_package_is_typed():
    assert (Path(gsgan.__file__).parent / "py.typed").is_file()


def test_the_examples_of_the_page_run(run, tmp_path, monkeypatch):
    """In the order of the page, which the blocks share."""
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    assert len(BLOCKS) == 5
    namespace = {}
    for block in BLOCKS:
        code = re.sub(r"runs/\d[\d-]*/[\d-]*", run.as_posix(), block)
        exec(code, namespace)
    written = {path.name for path in tmp_path.glob("*.png")}
    assert {"densify.png", "segmentation.png", "live_0.png"} <= written
    assert namespace["means"].grad.abs().sum() > 0
    deformed, points = namespace["deformed"], namespace["points"]
    assert (deformed.means - points.means).abs().max() < 1e-5

    # Lengths of the page's Ψ and of the avatar's own are the same quantity.
    avatar, psi = namespace["avatar"], namespace["psi"]
    own = avatar.template.stature_of(avatar.limb_length_sum)
    assert avatar.deformation.stature == avatar.stature == own
    body, pose = namespace["body"], namespace["pose"]
    height = body.posed_vertices(pose)[0, :, 2]
    true = float(height.max() - height.min())
    assert psi.stature == pytest.approx(true, rel=0.05)
