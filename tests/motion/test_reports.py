"""Files after public bug reports: each kind is read right, also when written another way."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_motion_readers import directions, standard

from gsgan.motion.bvh import read_bvh
from gsgan.motion.clip import frame_times, usual_rate
from gsgan.motion.readers import Source, read_motion
from gsgan.motion.standard import find_joints
from gsgan.skeleton.proportions import BONES
from gsgan.utils.errors import DataError

FILES = Path(__file__).parent / "files"


@pytest.mark.parametrize(
    ("name", "fps"), [("phone", 50), ("motive", 30), ("noise", 30)]
)
def test_the_reported_files_are_read_right(name, fps, proportions):
    p, clip = standard(FILES / f"{name}.bvh", proportions)
    truth = np.load(FILES / "expected.npz")[name]
    assert len(p) == len(truth)
    assert clip.fps == fps
    ours, theirs = in_body(p[:, :33]), in_body(truth)
    degrees = np.degrees(np.arccos(np.clip((ours * theirs).sum(-1), -1, 1)))
    seen = [(clip.visibility[:, [a, b]] > 0).all() for a, b in BONES]
    assert sum(seen) >= len(BONES) - 4
    assert degrees[:, seen].max() < 15


def in_body(p: np.ndarray) -> np.ndarray:
    """Directions of limbs in the axes of the pelvis and trunk."""
    hips, shoulders = p[:, [23, 24]], p[:, [11, 12]]
    up = shoulders.mean(1) - hips.mean(1)
    left = hips[:, 0] - hips[:, 1]
    left -= (
        up
        * (left * up).sum(-1, keepdims=True)
        / (up * up).sum(-1, keepdims=True)
    )
    axes = np.stack([left, np.cross(up, left), up], axis=1)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return np.einsum("fij,fbj->fbi", axes, directions(p))


BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Chest
  {
    OFFSET 0 10 0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 10 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 90 0 0 0 0 {chest} 0 0 0
0 91 0 0 0 0 {chest} 0 0 0
"""


def written(tmp_path: Path, text: str, encoding: str = "utf-8") -> Path:
    path = tmp_path / "motion.bvh"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    "chest", ["0 0 0", "2e-6 -1e-6 3e-6", "0 10 0", "0 10.000002 0"]
)
def test_positions_are_counted_from_the_offset_or_the_parent(tmp_path, chest):
    """With noise too; in all cases the bone is where OFFSET puts it."""
    motion = read_bvh(written(tmp_path, BVH.replace("{chest}", chest)))
    assert motion.local is None
    np.testing.assert_allclose(
        motion.pose()[:, 1], [[0, 100, 0], [0, 101, 0]], atol=1e-4
    )


@pytest.mark.parametrize("chest", ["0 12 0", "3 11 0"])
def test_bones_that_do_stretch_keep_their_channels(tmp_path, chest):
    motion = read_bvh(written(tmp_path, BVH.replace("{chest}", chest)))
    assert motion.local is not None
    given = [float(word) for word in chest.split()]
    np.testing.assert_allclose(motion.pose()[0, 1], np.add(given, [0, 90, 0]))


@pytest.mark.parametrize(
    ("before", "after", "encoding"),
    [
        ("", "", "utf-8-sig"),
        ("", "", "utf-16"),
        ("\n", "\n", "utf-8"),
        ("\n", "\r\n", "utf-8"),
        ("Frames: ", "Frames:", "utf-8"),
        ("Frame Time: ", "Frame Time:\t", "utf-8"),
        ("{\n", "{ ", "utf-8"),
        ("Hips\n{", "Hips{", "utf-8"),
    ],
)
def test_spaces_line_ends_and_marks_do_not_matter(
    tmp_path, before, after, encoding
):
    text = BVH.replace("{chest}", "0 0 0")
    changed = text.replace(before, after) if before else text
    motion = read_bvh(written(tmp_path, changed + "\x1a", encoding))
    plain = read_bvh(written(tmp_path, text))
    assert motion.names == plain.names
    np.testing.assert_array_equal(motion.rotations, plain.rotations)
    np.testing.assert_array_equal(motion.root, plain.root)


def test_a_motion_without_any_joint_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, p=np.full((3, 33, 3), np.nan))
    with pytest.raises(DataError, match="no joint"):
        read_motion(path, Source(None))


def test_a_rate_in_place_of_the_time_is_a_rate(tmp_path):
    text = BVH.replace("{chest}", "0 0 0").replace("0.0333333", "30")
    assert read_bvh(written(tmp_path, text)).frame_time == pytest.approx(1 / 30)


@pytest.mark.parametrize(
    ("seconds", "rate"),
    [
        (0.0333333, 30),
        (0.033333, 30),
        (0.0083333, 120),
        (0.008333, 120),
        (0.0166667, 60),
        (0.04, 25),
        (0.041667, 24),
        (0.02, 50),
        (1 / 29.97, 29.97),
        (1 / 23.976, 23.976),
    ],
)
def test_rates_lose_their_rounding_and_films_rates_stay(seconds, rate):
    assert usual_rate(1 / seconds) == pytest.approx(rate, rel=1e-9)


@pytest.mark.parametrize("frames", [1, 2, 13, 1000])
@pytest.mark.parametrize("fps", [30.0, 30.0003, 29.9997])
def test_no_frame_is_lost_by_rounding(frames, fps):
    times = frame_times(frames, fps, 30.0)
    assert abs(len(times) - frames) <= int(frames == 1000)
    assert times[-1] <= frames - 1


NAMES = {
    "mocopi": "l_up_leg l_low_leg l_foot l_toes l_up_arm l_low_arm l_hand",
    "Motive": "LThigh LShin LFoot LToe LUArm LFArm LHand",
    "SMPL": "L_Hip L_Knee L_Ankle L_Foot L_Shoulder L_Elbow L_Wrist",
    "SMPL-X": "left_hip left_knee left_ankle left_foot left_shoulder left_elbow left_wrist",
    "DAZ": "lThighBend lShin lFoot lToe lShldrBend lForearmBend lHand",
    "Mixamo": "mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase "
    "mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand",
}
LIMB = ["UpLeg", "Leg", "Foot", "ToeBase", "Arm", "ForeArm", "Hand"]


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_joints_of_common_exporters_are_known(names):
    known = find_joints(tuple(names.split()))
    assert known == {f"Left{bone}": place for place, bone in enumerate(LIMB)}


LIMBS_OF = {
    "l_hip l_knee l_ankle l_toe l_shoulder l_elbow l_wrist": "my_rig_{}",
    "L_Thigh L_Calf L_Foot L_Toe0 L_UpperArm L_Forearm L_Hand": "ValveBiped.Bip01_{}",
    "LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftArm LeftForeArm LeftHand": "Robot_{}",
    "thigh.L shin.L foot.L toe.L upper_arm.L forearm.L hand.L": "ORG-{}",
    "left_upLeg left_leg left_foot left_toes left_arm left_forearm left_hand": "{}_joint",
    "l_upleg l_leg l_foot l_toebase l_arm l_forearm l_hand": "{}_JNT",
    "HipLeft KneeLeft AnkleLeft ToeLeft ShoulderLeft ElbowLeft WristLeft": "m{}",
    "thigh_stretch.l leg_stretch.l foot.l toes_01.l arm_stretch.l forearm_stretch.l hand.l": "{}",
}


@pytest.mark.parametrize("words", LIMBS_OF, ids=LIMBS_OF.get)
def test_words_that_all_joints_share_are_no_part_of_their_names(words):
    trunk = [f"spine{k}" for k in range(6)]
    names = map(LIMBS_OF[words].format, [*words.split(), *trunk])
    known = find_joints(tuple(names))
    assert known == {f"Left{bone}": place for place, bone in enumerate(LIMB)}


def test_daz_fingers_and_twists():
    known = find_joints(
        ("lMid1", "lMid2", "lPinky1", "lThumb1", "lForearmTwist", "lThighTwist")
    )
    assert known == {
        "LeftHandMiddle1": 0,
        "LeftHandMiddle2": 1,
        "LeftHandPinky1": 2,
        "LeftHandThumb1": 3,
    }


# -- landmarks


def test_zeros_are_missing_in_every_format(tmp_path, landmarks, proportions):
    p = landmarks.copy()
    p[3:6, 13] = 0  # a left elbow
    np.savez(tmp_path / "p.npz", p=p)
    np.save(tmp_path / "p.npy", {"p": p}, allow_pickle=True)
    frames = [
        [{"x": x, "y": y, "z": z} for x, y, z in frame] for frame in p.tolist()
    ]
    (tmp_path / "p.json").write_text(json.dumps(frames))
    for name in ("p.npz", "p.npy", "p.json"):
        clip = read_motion(tmp_path / name, Source(proportions))
        assert np.isnan(clip.p[3:6, 13]).all(), name
        assert (clip.visibility[3:6, 13] == 0).all(), name
        assert np.isfinite(clip.p[:, 11]).all(), name


def test_a_visibility_of_zero_everywhere_is_none(
    tmp_path, landmarks, proportions
):
    def point(xyz: list[float], visibility: float) -> dict[str, float]:
        return dict(
            zip(("x", "y", "z", "visibility"), [*xyz, visibility], strict=True)
        )

    frames = [
        [point(xyz, 0.0) for xyz in frame] for frame in landmarks.tolist()
    ]
    path = tmp_path / "p.json"
    path.write_text(json.dumps(frames))
    assert (read_motion(path, Source(proportions)).visibility == 1).all()
    frames[0][0]["visibility"] = 0.5  # then the others are not seen
    path.write_text(json.dumps(frames))
    assert read_motion(path, Source(proportions)).visibility.sum() == 0.5


def test_tensorflow_js_in_three_dimensions(tmp_path, landmarks, proportions):
    def pose(frame: list[list[float]]) -> dict:
        points = [{"x": x, "y": y, "z": z, "score": 0.9} for x, y, z in frame]
        return {
            "keypoints": [{"x": 1, "y": 2, "score": 1}] * 33,
            "keypoints3D": points,
        }

    for name, wrap in (
        ("flat", lambda one: one),
        ("people", lambda one: [one]),
    ):
        path = tmp_path / f"{name}.json"
        path.write_text(
            json.dumps([wrap(pose(frame)) for frame in landmarks.tolist()])
        )
        clip = read_motion(path, Source(proportions))
        np.testing.assert_allclose(clip.p, landmarks)
        assert (clip.visibility == 0.9).all()


TRC = "PathFileType\t4\t(X/Y/Z)\tm.trc\n{keys}\n{values}\nFrame#\tTime\t{markers}\n\t\t\n"
MARKERS = {
    "LShoulder": 11,
    "RShoulder": 12,
    "LHip": 23,
    "RHip": 24,
    "LKnee": 25,
    "RKnee": 26,
}


def write_trc(
    path: Path, p: np.ndarray, *, prefix: str = "", units: str | None = "m"
) -> Path:
    scale = {"m": 1, "mm": 1000, "cm": 100, None: 1000}[units]
    keys = ["DataRate", "CameraRate", "NumFrames", "NumMarkers"] + (
        ["Units"] if units else []
    )
    values = ["25", "25", str(len(p)), str(len(MARKERS))] + (
        [units] if units else []
    )
    markers = "\t\t\t".join(prefix + name for name in MARKERS)
    text = TRC.format(
        keys="\t".join(keys), values="\t".join(values), markers=markers
    )
    for i, frame in enumerate(p):
        row = [
            x
            for joint in MARKERS.values()
            for x in (frame[joint][[1, 2, 0]] * scale)
        ]
        text += "\t".join(map(str, [i + 1, i / 25, *row])) + "\n"
    path.write_text(text)
    return path


@pytest.mark.parametrize("prefix", ["", "Subject1:", "Skeleton 001:"])
@pytest.mark.parametrize("units", ["m", "mm", None])
def test_markers_with_a_prefix_and_files_without_units(
    tmp_path, landmarks, proportions, prefix, units
):
    clip = read_motion(
        write_trc(tmp_path / "m.trc", landmarks, prefix=prefix, units=units),
        Source(proportions),
    )
    np.testing.assert_allclose(clip.p[:, 23], landmarks[:, 23], atol=1e-9)
    assert clip.fps == 25


@pytest.mark.parametrize("unit", ["meters", "M"])
def test_units_are_known_by_their_words(tmp_path, landmarks, proportions, unit):
    path = write_trc(tmp_path / "m.trc", landmarks)
    path.write_text(path.read_text().replace("\tm\n", f"\t{unit}\n"))
    clip = read_motion(path, Source(proportions))
    np.testing.assert_allclose(clip.p[:, 23], landmarks[:, 23], atol=1e-9)


def test_markers_of_half_a_trunk_and_columns_without_tabs_are_named(
    tmp_path, landmarks, proportions
):
    path = write_trc(tmp_path / "m.trc", landmarks)
    text = path.read_text()
    path.write_text(text.replace("Shoulder", "_shoulder_study"))
    with pytest.raises(DataError, match="L_shoulder_study"):
        read_motion(path, Source(proportions))
    path.write_text(text.replace("\t", "  "))
    with pytest.raises(DataError, match="separated by tabs"):
        read_motion(path, Source(proportions))


def test_markers_without_a_trunk_are_named(tmp_path, landmarks, proportions):
    path = write_trc(tmp_path / "m.trc", landmarks)
    path.write_text(
        path.read_text().replace("Shoulder", "Elbow").replace("Hip", "Wrist")
    )
    with pytest.raises(DataError, match=r"LElbow.*RWrist"):
        read_motion(path, Source(proportions))


def test_decimal_commas_are_read_as_points(tmp_path):
    text = BVH.replace("{chest}", "0.5 12.25 -1e-05")
    path = tmp_path / "a.bvh"
    path.write_text(text)
    points = read_bvh(path)
    path.write_text(text.replace(".", ","))
    commas = read_bvh(path)
    assert commas.frame_time == points.frame_time
    np.testing.assert_array_equal(commas.root, points.root)
    np.testing.assert_array_equal(commas.local, points.local)

    path.write_text(text.replace("0.0333333", "0"))
    with pytest.raises(DataError, match="its Frame Time is 0"):
        read_bvh(path)

    # Commas that are no decimal ones are refused.
    path.write_text(text.replace("0 91 0", "0,5 1.5 0"))
    with pytest.raises(DataError, match="'0,5'"):
        read_bvh(path)
