"""Models of the SMPL family: pickled files, and poses with a closed form."""

import math
import pickle

import numpy as np
import pytest
import torch
from writers import python2
from writers.smpl import PARENTS, joint_positions, smpl_arrays, write_smpl

from gsgan.body import free_body, open_body, skin
from gsgan.body.skinned import carry
from gsgan.body.smpl import SkinnedModel, from_zju, read_smpl
from gsgan.body.smpl_names import CIHP, CLOTHES, SMPL_JOINTS, SMPLX_JOINTS
from gsgan.model.segmentation import Segmentation
from gsgan.scene import BodyPose, Camera
from gsgan.utils.errors import DataError

D = torch.float64
SMALL = 120


@pytest.fixture
def small(tmp_path):
    """Writes a small model file and reads it."""

    def build(
        name: str = "model.pkl", **options
    ) -> tuple[SkinnedModel, dict[str, np.ndarray]]:
        written = write_smpl(tmp_path / name, vertices=SMALL, **options)
        return read_smpl(tmp_path / name), written

    return build


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("model.pkl", {"protocol": 2, "chumpy": True}),
        ("model.pkl", {"protocol": 0, "chumpy": True}),
        ("model.pkl", {"protocol": 2, "sparse": False}),
        ("model.pkl", {"protocol": 4, "chumpy": True}),
        ("model.pkl", {"protocol": 5, "sparse": False}),
        ("model.npz", {}),
        ("renamed.npy", {"protocol": 2}),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", ["smpl", "smplx"])
def test_every_kind_of_file_is_read_back(small, kind, name, options):
    model, written = small(name, kind=kind, **options)
    assert model.kind == kind
    assert model.parents == PARENTS[kind]
    for key in ("v_template", "posedirs", "J_regressor", "weights"):
        np.testing.assert_allclose(
            getattr(model, key).numpy(), written[key], atol=1e-15
        )
    both = torch.cat([model.shapedirs, model.expression_dirs], dim=-1)
    np.testing.assert_array_equal(both.numpy(), written["shapedirs"])
    assert model.shapedirs.shape[-1] == 10
    np.testing.assert_array_equal(model.faces.numpy(), written["f"])


def test_files_of_the_original_sizes_are_read(tmp_path):
    write_smpl(tmp_path / "SMPL_NEUTRAL.pkl", chumpy=True)
    model = read_smpl(tmp_path / "SMPL_NEUTRAL.pkl")
    assert model.v_template.shape == (6890, 3)
    joints = model.rest_joints(torch.zeros(1, 10))[0].numpy()
    np.testing.assert_allclose(joints, joint_positions("smpl"), atol=1e-12)


def test_shape_and_expression_are_split_by_their_number(small):
    arrays = smpl_arrays("smplx", SMALL)
    many = np.zeros((SMALL, 3, 400))
    model, _ = small(kind="smplx", replace={"shapedirs": many})
    assert (model.shapedirs.shape[-1], model.expression_dirs.shape[-1]) == (
        300,
        100,
    )
    ten, _ = small(
        kind="smplx", replace={"shapedirs": arrays["shapedirs"][..., :10]}
    )
    assert (ten.shapedirs.shape[-1], ten.expression_dirs.shape[-1]) == (10, 0)
    smpl, _ = small(kind="smpl", replace={"shapedirs": many[..., :300]})
    assert (smpl.shapedirs.shape[-1], smpl.expression_dirs.shape[-1]) == (
        300,
        0,
    )


def test_joint_names():
    assert (len(SMPL_JOINTS), len(SMPLX_JOINTS)) == (24, 55)
    assert SMPLX_JOINTS[25:28] == ("left_index1", "left_index2", "left_index3")
    assert SMPLX_JOINTS[54] == "right_thumb3"
    assert free_body().label_names == CLOTHES
    assert (len(CIHP), CIHP[13]) == (20, "face")


# --- poses -------------------------------------------------------------------------------------


def test_zero_pose_is_the_shaped_rest_moved(small):
    model, written = small()
    betas = torch.tensor([[1.0, -2.0, 0.5]], dtype=D)
    transl = torch.tensor([[1.0, 2.0, 3.0]], dtype=D)
    vertices, joints = model.pose(torch.zeros(1, 24, 3, dtype=D), betas, transl)
    shaped = (
        written["v_template"] + written["shapedirs"][..., :3] @ betas[0].numpy()
    )
    np.testing.assert_allclose(
        vertices[0].numpy(), shaped + transl.numpy(), atol=1e-12
    )
    rest = written["J_regressor"] @ shaped
    np.testing.assert_allclose(
        joints[0].numpy(), rest + transl.numpy(), atol=1e-12
    )
    torch.testing.assert_close(joints, model.rest_joints(betas) + transl)


def test_a_quarter_turn_of_one_joint(small):
    """The left elbow about z: joints below it rotate rigidly about it, the rest does not move."""
    model, written = small()
    theta = torch.zeros(1, 24, 3, dtype=D)
    elbow = SMPL_JOINTS.index("left_elbow")
    theta[0, elbow, 2] = math.pi / 2
    _, joints = model.pose(
        theta, torch.zeros(1, 10), torch.zeros(1, 3), pose_blend=False
    )
    rest = written["J_regressor"] @ written["v_template"]
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = rest.copy()
    for name in ("left_wrist", "left_hand"):
        j = SMPL_JOINTS.index(name)
        expected[j] = turn @ (rest[j] - rest[elbow]) + rest[elbow]
    np.testing.assert_allclose(joints[0].numpy(), expected, atol=1e-12)


def test_vertices_follow_their_weights(small):
    arrays = smpl_arrays("smpl", SMALL)
    weights = np.zeros((SMALL, 24))
    weights[:, 0] = 1
    weights[7] = 0
    weights[7, [0, 4]] = 0.5  # half with the root, half with the left knee
    model, _ = small(replace={"weights": weights})
    theta = torch.zeros(1, 24, 3, dtype=D)
    theta[0, 4, 0] = math.pi
    vertices, _ = model.pose(
        theta, torch.zeros(1, 10), torch.zeros(1, 3), pose_blend=False
    )
    rest = arrays["v_template"]
    knee = (arrays["J_regressor"] @ rest)[4]
    turned = knee + (rest[7] - knee) * [1, -1, -1]
    expected = rest.copy()
    expected[7] = (rest[7] + turned) / 2
    np.testing.assert_allclose(vertices[0].numpy(), expected, atol=1e-12)


def test_pose_blend_shapes_by_hand(small):
    """One direction, of entry (1, 2) of the left knee's rotation: -sin of a turn about x."""
    posedirs = np.zeros((SMALL, 3, 207))
    knee = SMPL_JOINTS.index("left_knee")
    posedirs[3, 0, 9 * (knee - 1) + 5] = 0.2
    weights = np.zeros((SMALL, 24))
    weights[:, 0] = 1
    model, written = small(replace={"posedirs": posedirs, "weights": weights})
    theta = torch.zeros(1, 24, 3, dtype=D)
    theta[0, knee, 0] = 0.4
    args = (theta, torch.zeros(1, 10), torch.zeros(1, 3))
    with_blend, without = (
        model.pose(*args)[0],
        model.pose(*args, pose_blend=False)[0],
    )
    moved = (with_blend - without)[0].numpy()
    expected = np.zeros((SMALL, 3))
    expected[3, 0] = -0.2 * math.sin(0.4)
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    theta[0, 0] = torch.tensor(
        [0.3, 0.2, 0.1]
    )  # the root's own rotation adds nothing
    theta[0, knee] = 0
    torch.testing.assert_close(
        model.pose(*args)[0], model.pose(*args, pose_blend=False)[0]
    )
    assert not np.allclose(
        written["v_template"], model.pose(*args)[0][0].numpy()
    )


def test_the_root_turns_about_its_own_joint_and_expression_moves_the_face(
    small,
):
    model, written = small(kind="smplx")
    theta = torch.zeros(2, 55, 3, dtype=D)
    theta[:, 0, 1] = torch.tensor([0.0, 1.0])
    betas, face = (
        torch.zeros(1, 10, dtype=D),
        torch.tensor([[0.0, 2.0]], dtype=D),
    )
    vertices, joints = model.pose(
        theta, betas, torch.zeros(2, 3), face.expand(2, -1)
    )
    torch.testing.assert_close(joints[0, 0], joints[1, 0])
    np.testing.assert_allclose(
        vertices[0].numpy(),
        written["v_template"] + 2 * written["shapedirs"][..., 11],
        atol=1e-12,
    )


def test_gradients_at_rest_are_finite_and_correct(small):
    model, _ = small()
    theta = torch.zeros(1, 24, 3, dtype=D, requires_grad=True)
    betas = torch.zeros(1, 2, dtype=D, requires_grad=True)
    transl = torch.zeros(1, 3, dtype=D, requires_grad=True)

    def some(*inputs):
        vertices, joints = model.pose(*inputs)
        return vertices[:, ::40], joints[:, -1]

    assert torch.autograd.gradcheck(
        some, (theta, betas, transl), atol=1e-6, fast_mode=True
    )


def test_wrong_shapes_name_the_argument(small):
    model, _ = small()
    good = {
        "theta": torch.zeros(2, 24, 3),
        "betas": torch.zeros(2, 10),
        "transl": torch.zeros(2, 3),
        "expression": None,
    }
    wrong = {
        "theta": (2, 55, 3),
        "betas": (2, 11),
        "transl": (1, 3),
        "expression": (2, 1),
    }
    for name, shape in wrong.items():
        with pytest.raises(
            ValueError, match="rotations" if name == "theta" else name
        ):
            model.pose(**(good | {name: torch.zeros(shape)}))


def test_zju_convention(small):
    """R(Rh) LBS(zero root) + Th, about the origin, is our root rotation and translation."""
    model, _ = small()
    rng = np.random.default_rng(0)
    Rh, Th = rng.standard_normal((2, 5, 3))
    betas = torch.from_numpy(rng.standard_normal((1, 10)))
    poses = torch.from_numpy(0.3 * rng.standard_normal((5, 24, 3)))
    poses[:, 0] = 0
    local, _ = model.pose(poses, betas, torch.zeros(5, 3))
    R = torch.linalg.matrix_exp(
        torch.tensor(
            [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in Rh], dtype=D
        )
    )
    theirs = local @ R.mT + torch.from_numpy(Th)[:, None]
    J0 = model.rest_joints(betas)[0, 0].numpy()
    orient, transl = from_zju(Rh, Th, J0)
    poses[:, 0] = torch.from_numpy(orient)
    ours, _ = model.pose(poses, betas, torch.from_numpy(transl))
    torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=0)
    assert np.abs(transl - Th).max() > 0.01  # skipping it would be seen


# --- as a body for segmentation ----------------------------------------------------------------


def test_as_body_labels_by_the_first_largest_weight(small):
    weights = np.zeros((SMALL, 24))
    weights[:, SMPL_JOINTS.index("head")] = 1
    weights[5] = 0
    weights[5, [4, 18]] = 0.5  # left knee and left elbow alike
    weights[6] = 0
    weights[6, [4, 18]] = 0.4, 0.6
    model, _ = small(replace={"weights": weights})
    for parts, expected in {
        "clothes": ("face_neck", "left_leg", "left_arm"),
        "cihp": ("face", "left_leg", "left_arm"),
        "joints": ("head", "left_knee", "left_elbow"),
    }.items():
        body = model.as_body(parts=parts)
        named = [body.label_names[label] for label in body.vertex_labels[4:7]]
        assert tuple(named) == expected
        assert int(body.vertex_labels.min()) > 0  # the background has no vertex


def test_as_body_moves_as_the_model_without_blend_shapes(small):
    model, _ = small(kind="smplx")
    betas = torch.tensor([[0.5, -1.0]], dtype=D)
    body = model.as_body(betas[0])
    theta = 0.4 * torch.randn(
        2, 55, 3, generator=torch.Generator().manual_seed(0)
    )
    transl = torch.tensor([[0.0, 1, 2], [3, 4, 5]])
    vertices, joints = model.pose(theta, betas, transl, pose_blend=False)
    pose = BodyPose(theta, transl)
    torch.testing.assert_close(
        body.posed_vertices(pose).double(), vertices, atol=1e-5, rtol=0
    )
    own = carry(body.transforms(pose), body.joints)
    torch.testing.assert_close(own.double(), joints, atol=1e-5, rtol=0)
    A, t = body.pose(pose)
    torch.testing.assert_close(
        skin(body.vertices, A, t), body.posed_vertices(pose)
    )


def test_segmentation_is_built_from_a_model_file(tmp_path):
    write_smpl(tmp_path / "m.pkl", vertices=2000)
    body = open_body("smpl", str(tmp_path / "m.pkl"), (0.1, 0.2), CIHP)
    assert body.label_names == CIHP
    K = torch.tensor([[[35.0, 0, 16], [0, 35, 16], [0, 0, 1]]])
    R = torch.tensor(
        [[[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]]
    )  # in front of it, Y up
    camera = Camera(
        K,
        R,
        -(R @ torch.tensor([[[0.0], [0.85], [3.0]]])).squeeze(-1),
        (32, 32),
    )
    with torch.no_grad():
        segmentation = Segmentation(body)
        S = segmentation(
            BodyPose(torch.zeros(1, 24, 3), torch.zeros(1, 3)), camera
        )
    names = segmentation.map.names
    assert S.shape == (1, len(names), 32, 32)
    assert "hat" in segmentation.map.absent  # no joint wears one: no channel
    columns = torch.arange(32.0)
    left, right = (
        float(
            (S[0, names.index(name)].sum(0) * columns).sum()
            / S[0, names.index(name)].sum()
        )
        for name in ("left_arm", "right_arm")
    )
    assert left > 16 > right  # it faces the camera


def test_open_body_chooses_parts_by_the_labels_names(tmp_path):
    path = str(tmp_path / "m.pkl")
    write_smpl(tmp_path / "m.pkl", vertices=SMALL)
    assert open_body("smpl", path).label_names == CLOTHES
    assert open_body("smpl", path, (), CLOTHES).label_names == CLOTHES
    joints = ("background", *SMPL_JOINTS)
    assert open_body("smpl", path, (), joints).label_names == joints
    assert open_body("free") is free_body()
    assert open_body("smpl") is None
    assert open_body(None) is None
    assert open_body("smpl", path, (), joints).shares_labels(joints)
    assert free_body().shares_labels(CLOTHES[:5])
    # clothes on a model file are a guess
    for names in (CLOTHES, CIHP, ("background", "hat")):
        assert not open_body("smpl", path, (), names).shares_labels(names)
    with pytest.raises(
        DataError,
        match=r"smpl .*24.* smplx",
    ):
        open_body("smplx", path)
    with pytest.raises(DataError, match=r"10 .*11"):
        open_body("smpl", path, (0.0,) * 11)


# --- files that are wrong ----------------------------------------------------------------------

NAN = np.full((SMALL, 3), np.nan)
WRONG = {
    "key": ({"drop": ("posedirs", "f")}, "posedirs, f"),
    "template": (
        {"replace": {"v_template": np.zeros((SMALL, 2))}},
        r"\(120, 2\)",
    ),
    "nan": ({"replace": {"v_template": NAN}}, "v_template"),
    "posedirs": (
        {"replace": {"posedirs": np.zeros((SMALL, 3, 135))}},
        r"posedirs.*\(120, 3, 207\).*\(120, 3, 135\)",
    ),
    "vertices": (
        {"replace": {"weights": np.ones((7, 24))}},
        r"\(120, 24\).*\(7, 24\)",
    ),
    "weights": (
        {"replace": {"weights": np.ones((SMALL, 24))}},
        "vertex 0 .*24",
    ),
    "faces": (
        {"replace": {"f": np.array([[0, 1, SMALL]])}},
        "120.* 0 to 120",
    ),
    "text": (
        {"replace": {"f": np.array([["a", "b", "c"]])}},
        "'f'",
    ),
    "tree": (
        {"replace": {"kintree_table": np.zeros((2, 24), int)}},
        "1 joints.*24 columns",
    ),
    "order": (
        {
            "replace": {
                "kintree_table": np.stack(
                    [np.arange(1, 25) % 24, np.arange(24)]
                )
            }
        },
        "joint 1",
    ),
    "regressor": (
        {"replace": {"J_regressor": np.zeros((SMALL, 24))}, "sparse": False},
        r"J_regressor.*\(24, 120\)",
    ),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_a_model_file_of_another_body_is_refused(small, name):
    options, match = WRONG[name]
    with pytest.raises(DataError, match=match) as caught:
        small(**options)
    assert "model.pkl" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_not_models_are_refused(tmp_path):
    path = tmp_path / "other.pkl"
    path.write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(DataError, match="list"):
        read_smpl(path)
    path.write_bytes(python2.dumps({"poses": np.zeros((1, 72))}))
    with pytest.raises(DataError, match=r"other\.pkl"):
        read_smpl(path)
    path.write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(DataError, match=r"os\.system"):
        read_smpl(path)
    with pytest.raises(DataError, match=r"absent\.pkl"):
        read_smpl(tmp_path / "absent.pkl")


def test_a_model_of_another_kind_is_generic(tmp_path):
    """Sixteen joints, as a hand has."""
    kept = {"weights": np.eye(16)[np.zeros(SMALL, int)]}
    kept |= {"kintree_table": np.stack([np.arange(-1, 15), np.arange(16)])}
    kept |= {"J_regressor": np.full((16, SMALL), 1 / SMALL)}
    kept |= {"posedirs": np.zeros((SMALL, 3, 135))}
    write_smpl(tmp_path / "hand.pkl", vertices=SMALL, replace=kept)
    model = read_smpl(tmp_path / "hand.pkl")
    assert model.kind == "generic"
    assert model.as_body(parts="joints").label_names[:2] == (
        "background",
        "joint0",
    )
    with pytest.raises(ValueError, match=r"parts.*joints"):
        model.as_body()
