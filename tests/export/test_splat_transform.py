"""PlayCanvas' splat-transform, which no one here wrote, reads the .ply and .glb files."""

import shutil
import subprocess

import numpy as np
import pandas as pd
import pygltflib
import pytest
import trimesh

VERSION = "2.7.1"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def convert(tmp_path_factory):
    """``convert(source, target)`` by splat-transform, which npm installs."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    folder = tmp_path_factory.mktemp("npm")
    package = f"@playcanvas/splat-transform@{VERSION}"
    command = [npm, "install", "--silent", "--prefix", str(folder), package]
    installed = subprocess.run(command, capture_output=True, text=True)
    if installed.returncode != 0:
        pytest.skip(f"npm cannot install {package}: {installed.stderr}")
    program = folder / "node_modules" / ".bin" / "splat-transform"

    def run(source, target) -> None:
        words = [program, "--gpu", "cpu", "--overwrite", source, target]
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr

    return run


@pytest.fixture
def exported(inside, tmp_path):
    """The avatar that comes with gsgan in its rest pose, as rest.ply and rest.glb."""
    for kind, name in (("ply", "rest.ply"), ("gltf", "rest.glb")):
        given = ("run=demo", "motion=rest", f"format={kind}", f"out={name}")
        result = inside("export", *given)
        assert result.returncode == 0, result.stdout + result.stderr
    return tmp_path


def test_every_value_of_a_ply_is_read(convert, exported):
    convert(exported / "rest.ply", exported / "read.csv")
    read = pd.read_csv(exported / "read.csv")
    ply = trimesh.load(exported / "rest.ply")
    written = ply.metadata["_ply_raw"]["vertex"]["data"]
    assert len(read.columns) == 62
    for name in read.columns:
        assert np.array_equal(read[name], written[name].astype(float)), name


@pytest.mark.parametrize("name", ["a.spz", "a.sog"])
def test_a_ply_is_compressed(convert, exported, name):
    """Back as .ply, Gaussians are within a millimetre, in a tenth of the bytes."""
    packed = exported / name
    convert(exported / "rest.ply", packed)
    before = (exported / "rest.ply").stat().st_size
    assert packed.stat().st_size < 0.1 * before
    convert(packed, exported / "back.ply")
    sizes = []
    for path in (exported / "rest.ply", exported / "back.ply"):
        points = trimesh.load(path).vertices
        sizes.append(np.stack([points.min(axis=0), points.max(axis=0)]))
    assert np.abs(sizes[0] - sizes[1]).max() < 1e-3  # .sog sorts Gaussians


def test_its_glb_has_the_extension_of_ours(convert, exported):
    """Both files name the extension, its attributes and its properties alike."""
    convert(exported / "rest.ply", exported / "theirs.glb")
    ours = pygltflib.GLTF2().load(str(exported / "rest.glb"))
    theirs = pygltflib.GLTF2().load(str(exported / "theirs.glb"))
    assert theirs.extensionsUsed == ours.extensionsUsed
    ours, theirs = (x.meshes[0].primitives[0] for x in (ours, theirs))
    assert ours.mode == theirs.mode
    extension = "KHR_gaussian_splatting"
    properties = theirs.extensions[extension]
    assert ours.extensions[extension].items() <= properties.items()
    names = {key for key, x in vars(ours.attributes).items() if x is not None}
    assert names <= set(vars(theirs.attributes))


@pytest.mark.parametrize("kind", ["spz", "splat"])
def test_packed_files_are_read_as_the_ply(convert, exported, inside, kind):
    """Gaussians are within a millimetre; .spz has Y up, and .splat another order."""
    given = ("run=demo", "motion=rest", f"format={kind}", f"out=rest.{kind}")
    result = inside("export", *given)
    assert result.returncode == 0, result.stdout + result.stderr
    tables = []
    for name in ("rest.ply", f"rest.{kind}"):
        convert(exported / name, exported / "read.csv")
        tables.append(pd.read_csv(exported / "read.csv"))
    ply, packed = tables
    assert len(ply) == len(packed)
    extents = []
    for table in tables:
        x = table[["x", "y", "z"]].to_numpy()
        extents.append(np.sort(np.ptp(x, axis=0)))
    np.testing.assert_allclose(*extents, atol=1e-3)
    shown = [1 / (1 + np.exp(-table["opacity"])) for table in tables]
    np.testing.assert_allclose(shown[0].mean(), shown[1].mean(), atol=0.01)
    for name in ("f_dc_0", "f_dc_1", "f_dc_2"):
        np.testing.assert_allclose(
            ply[name].mean(), packed[name].mean(), atol=0.02
        )
