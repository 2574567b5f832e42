"""3D joints that another tool wrote: units, axes, names, filled gaps."""

from pathlib import Path

import numpy as np
import pytest
from make import skeletons

from gsgan.motion.points import read_points3d
from gsgan.motion.readers import Source, read_motion
from gsgan.utils.errors import DataError

MARKERS = {
    "Nose": 0,
    **{
        f"L{part}": 2 * i + 11
        for i, part in enumerate(("Shoulder", "Elbow", "Wrist"))
    },
    **{
        f"R{part}": 2 * i + 12
        for i, part in enumerate(("Shoulder", "Elbow", "Wrist"))
    },
    "LHip": 23,
    "RHip": 24,
    "Lknee": 25,
    "right_knee": 26,
    "LBigToe": 31,
    "RBigToe": 32,
    "LHeel": 29,
    "RHeel": 30,
}


def write_trc(path: Path, p: np.ndarray, unit: str = "m") -> Path:
    """As Pose2Sim writes: (y, z, x) of the world, so that y is up; an unknown marker beside."""
    scale = {"m": 1, "mm": 1000}[unit]
    names = [*MARKERS, "Neck"]
    header = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]
    values = ["60", "60", str(len(p)), str(len(names)), unit]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "\t".join(header),
        "\t".join(values),
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(len(names))),
    ]
    for f, frame in enumerate(p):
        row = (
            np.vstack([frame[list(MARKERS.values())], [[9, 9, 9]]])[
                :, [1, 2, 0]
            ]
            * scale
        )
        cells = [
            "" if np.isnan(v) else repr(float(v))
            for v in np.where(row == 0, 0.0, row).ravel()
        ]
        lines.append("\t".join([str(f), str(f / 60), *cells]))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_c3d(path: Path, p: np.ndarray, unit: str, names=None) -> Path:
    """By another program's library: z up, joints with a prefix, an unknown marker beside."""
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    names = names or [f"Subject1:{name}" for name in MARKERS]
    points = np.ones((4, len(names) + 1, len(p)))
    scale = {"m": 1, "mm": 1000}[unit]
    places = scale * p[:, list(MARKERS.values())].transpose(2, 1, 0)
    points[:3, : len(MARKERS)] = places[:, : len(names)]
    file["parameters"]["POINT"]["RATE"]["value"] = [120.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["LABELS"]["value"] = [*names, "Wand"]
    file["data"]["points"] = points
    file.write(str(path))
    return path


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_joints_of_c3d_are_read(tmp_path, proportions, unit):
    p = skeletons(4)
    p[2, 15] = np.nan
    path = write_c3d(tmp_path / "a.c3d", p, unit)
    found = read_points3d(path)
    joints = list(MARKERS.values())
    np.testing.assert_allclose(found.p[:, joints], p[:, joints], atol=1e-6)
    assert found.conf[2, 15] == 0
    assert found.frames.tolist() == [1, 2, 3, 4]
    assert read_motion(path, Source(proportions)).fps == 120


def test_markers_on_the_skin_and_damaged_c3d_are_refused(tmp_path):
    skin = [f"M{i}" for i in range(len(MARKERS))]
    path = write_c3d(tmp_path / "a.c3d", skeletons(2), "m", skin)
    with pytest.raises(DataError, match=r"a\.c3d.*M3"):
        read_points3d(path)
    for size in (0, 10, 600, len(path.read_bytes()) - 40):
        cut = tmp_path / "cut.c3d"
        cut.write_bytes(path.read_bytes()[:size])
        with pytest.raises(DataError, match=r"cut\.c3d"):
            read_points3d(cut)


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_trc_units_axes_and_names_are_converted(tmp_path, proportions, unit):
    p = skeletons(4)
    p[2, 15] = np.nan
    found = read_points3d(write_trc(tmp_path / "a.trc", p, unit))
    joints = list(MARKERS.values())
    np.testing.assert_allclose(found[1][:, joints], p[:, joints], atol=1e-9)
    unknown = sorted(set(range(33)) - set(joints))
    assert np.isnan(found[1][:, unknown]).all()
    assert (found[2][:, unknown] == 0).all()
    assert found[2][2, 15] == 0
    assert read_motion(tmp_path / "a.trc", Source(proportions)).fps == 60


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda text: "hello", r"a\.trc"),
        (lambda text: text.replace("\tm\n", "\tfeet\n"), "Units.*'feet'"),
        (
            lambda text: text.replace("1.58", "x.yz"),
            r"a\.trc",
        ),
        (
            lambda text: text.replace("Shoulder", "Sh").replace("Hip", "H"),
            "LShoulder.*LHip",
        ),
    ],
)
def test_damaged_trc(tmp_path, change, what):
    path = write_trc(tmp_path / "a.trc", skeletons(2))
    path.write_text(change(path.read_text()))
    with pytest.raises(DataError, match=what):
        read_points3d(path)
