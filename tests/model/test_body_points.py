"""G on a skinned body: where the points are, that nothing else is built, that Ψ learns there."""

import math
from dataclasses import replace

import pytest
import torch
from commands import stored
from configs import build_training, load_avatar
from hydra.errors import ConfigCompositionException
from tiny_characters import TINY
from torch.nn import functional

from gsgan.body import open_body
from gsgan.body.lbs import stretch_jacobian
from gsgan.body.skinned import neighbours_on_surface, vertex_normals
from gsgan.data.datamodule import GsganData
from gsgan.data.surface_colours import body_inside
from gsgan.model.body_points import BodyPoints, move_normals
from gsgan.scene import BodyPose
from gsgan.synthetic.scenes import ensure_scene
from gsgan.utils.errors import DataError

ON = "effects.body_points=on"


@pytest.fixture(scope="module")
def body():
    return open_body("free", None, ())


def rest(body, batch: int = 1) -> BodyPose:
    return BodyPose(
        torch.zeros(batch, len(body.joints), 3), torch.zeros(batch, 3)
    )


def test_at_rest_the_points_are_vertices_and_their_frames_the_worlds(body):
    placed = BodyPoints(body, 1.7, points=200)
    points = placed(rest(body, 2))
    chosen = placed.points.chosen
    assert points.means.shape == (2, 200, 3)
    assert placed.n_points == len(chosen.unique()) == 200
    torch.testing.assert_close(points.means[1], body.vertices[chosen].float())
    torch.testing.assert_close(points.frames, torch.eye(3).expand(2, 200, 3, 3))


def test_a_turned_body_turns_points_and_frames(body):
    placed = BodyPoints(body, 1.7, points=200)
    pose = rest(body)
    theta = pose.theta.clone()
    theta[0, 0, 2] = torch.pi / 2  # the root, about the world's z
    before, after = placed(pose), placed(replace(pose, theta=theta))
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(after.frames[0, 7], quarter, atol=1e-6, rtol=0)
    between = before.means[0] - before.means[0, :1]
    torch.testing.assert_close(
        after.means[0] - after.means[0, :1],
        between @ quarter.mT,
        atol=1e-5,
        rtol=0,
    )


def test_a_shapes_last_bits_choose_no_other_points(body):
    noise = 1 + 2e-7 * torch.randn(
        body.vertices.shape, generator=torch.Generator().manual_seed(0)
    )
    noisy = replace(body, vertices=body.vertices * noise)
    points, same = (
        BodyPoints(b, 1.7, points=2000, controls=50).points
        for b in (body, noisy)
    )
    chosen = points.chosen
    assert torch.equal(same.chosen, chosen)
    assert torch.equal(same.learnt.near, points.learnt.near)
    other = BodyPoints(
        replace(noisy, template=None), 1.7, points=2000
    ).points.chosen
    assert not torch.equal(other, chosen)  # what the template is for


def test_learnt_weights_start_as_the_bodys_and_find_another_persons(body):
    torch.manual_seed(0)
    poses = replace(
        rest(body, 8), theta=0.4 * torch.randn(8, len(body.joints), 3)
    )
    own, learnt = (
        BodyPoints(body, 1.7, points=300, controls=n) for n in (0, 60)
    )
    assert (learnt(poses).means - own(poses).means).norm(dim=-1).max() < 0.01
    other = BodyPoints(body, 1.7, points=300, controls=60)
    with torch.no_grad():
        other.points.learnt.field += torch.randn_like(other.points.learnt.field)
        truth = other(poses).means
    field = learnt.points.learnt.field
    optimiser = torch.optim.Adam([field], 0.05)

    def error():
        return (learnt(poses).means - truth).square().sum(-1).mean()

    before = error().sqrt()
    for _ in range(60):
        optimiser.zero_grad()
        error().backward()
        optimiser.step()
    assert error().sqrt() < 0.3 * before
    with torch.no_grad():
        field *= 1e4
    weight = learnt.points.weights[1]
    torch.testing.assert_close(weight.sum(1), torch.ones(300))
    assert (
        torch.autograd.grad(learnt(poses).means.sum(), field)[0]
        .isfinite()
        .all()
    )


def test_in_a_high_kick_stretched_shapes_reach_their_neighbours(body):
    """An edge of the posed mesh is the image of the edge at rest under its vertex's shape."""
    placed = BodyPoints(body, 1.7)
    kick = rest(body)
    kick.theta[0, body.joint_names.index("upperleg01.L"), 0] = -2.6
    points = placed(kick)
    assert torch.equal(
        points.means, BodyPoints(body, 1.7, stretch=False)(kick).means
    )
    torch.testing.assert_close(
        placed(rest(body)).shapes, points.shapes * 0 + torch.eye(3)
    )
    a, b = body.faces[:, 0], body.faces[:, 1]
    edge = (body.vertices[b] - body.vertices[a]).unsqueeze(-1)
    posed = (points.means[0, b] - points.means[0, a]).norm(dim=-1)
    pulled = posed > 1.5 * edge.norm(dim=1).squeeze()
    assert pulled.sum() > 100
    reach = (points.shapes[0, a] @ edge).squeeze(-1).norm(dim=-1)[
        pulled
    ] / posed[pulled]
    plain = (points.frames[0, a] @ edge).squeeze(-1).norm(dim=-1)[
        pulled
    ] / posed[pulled]
    assert plain.median() < 0.6
    assert 0.85 < reach.median() < 1.15


def test_normals_point_out_of_the_posed_body(body):
    """Against trimesh, which knows the whole mesh: no formula shared."""
    import trimesh

    torch.manual_seed(1)
    pose = replace(rest(body), theta=0.15 * torch.randn(1, len(body.joints), 3))
    placed = BodyPoints(body, 1.7)
    points = placed(pose)
    mesh = trimesh.Trimesh(
        points.means[0].numpy(), body.faces.numpy(), process=False
    )
    face = torch.tensor(mesh.face_normals, dtype=torch.float32)
    agree = (points.normals[0][body.faces[:, 0]] * face).sum(-1)
    assert agree.median() > 0.97
    assert (agree > 0.5).float().mean() > 0.97


@pytest.mark.parametrize(
    ("name", "A", "expected"),
    [
        ("sheared", [[1.0, 0, 0.7], [0, 1, 0], [0, 0, 1]], [0.0, 0, 1]),
        (
            "flattened onto its tangent plane",
            [[1.0, 0, 0], [0, 1, 0], [0, 0, 0]],
            [0.0, 0, 1],
        ),
        (
            "flattened to a line",
            [[1.0, 0, 0], [0, 0, 0], [0, 0, 0]],
            [0.0, 0, 0],
        ),
        ("shrunk to nothing", [[0.0, 0, 0], [0, 0, 0], [0, 0, 0]], [0.0, 0, 0]),
        (
            "shrunk to a tenth",
            [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]],
            [0.0, 0, 0.7071],
        ),
    ],
)
def test_stability_normals_of_a_skin_that_is(name, A, expected):
    A = torch.tensor([[A]], requires_grad=True)
    normal = move_normals(A, torch.tensor([[0.0, 0.0, 1.0]]))
    torch.testing.assert_close(
        normal[0, 0].detach(), torch.tensor(expected), atol=1e-4, rtol=0
    )
    normal.sum().backward()
    assert torch.isfinite(A.grad).all()


def test_a_vertex_without_a_face_has_no_normal():
    corners = torch.tensor(
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [2, 0, 0]]
    )
    faces = torch.tensor([[0, 1, 2], [0, 1, 4]])  # the second has no area
    found = vertex_normals(corners, faces)
    up, none = [0.0, 0, 1], [0.0, 0, 0]
    torch.testing.assert_close(found, torch.tensor([up, up, up, none, none]))


def test_on_the_body_nothing_is_densified_and_off_it_no_body_is_built(build):
    _, avatar, frame = build(ON)
    assert avatar.densify is None
    painting = avatar(*frame.inputs)
    assert (
        painting.gaussians.means.shape[1] == avatar.body_points.n_points == 500
    )
    _, plain, frame = build("effects.body_points=off")
    assert plain.body_points is None
    assert (
        plain(*frame.inputs).gaussians.means.shape[1] == plain.densify.n_points
    )


def test_untrained_gaussians_sit_on_the_surface(build):
    _, avatar, frame = build(ON)
    means = avatar(*frame.inputs).gaussians.means
    torch.testing.assert_close(means, avatar.body_points(frame.body).means)


@pytest.mark.parametrize(
    ("part", "words", "said"),
    [
        (
            "body_points",
            (ON, "effects.impossible=off", "model=wo_seg"),
            r"effects\.body_points=on",
        ),
        ("segmentation", ("effects.body_points=off",), "S"),
    ],
)
def test_a_trained_avatar_without_its_body_is_refused_in_one_sentence(
    tiny, tmp_path, monkeypatch, part, words, said
):
    config = tiny(*words)
    data, module = build_training(config)
    stored(module, tmp_path)
    avatar, _ = load_avatar(tmp_path, config, data)
    assert getattr(avatar, part) is not None
    for place in ("assemble", "class_vote"):
        monkeypatch.setattr(f"gsgan.run.{place}.open_body", lambda *_: None)
    with pytest.raises(
        DataError,
        match=rf"{said}.*data.smpl",
    ):
        load_avatar(tmp_path, config, data)


def test_a_fitting_body_lies_in_its_mask_and_a_shifted_one_leaves_it(body):
    given = TINY | {
        "size": 64,
        "train_cameras": 2,
        "test_cameras": 0,
        "frames": 2,
    }
    root = ensure_scene(**given | {"test_frames": 0}, workers=1, progress=False)
    frame = GsganData(root=root, size=64).dataset("train")[0]
    exact = body_inside(frame, body)
    pose = frame.body
    away = replace(
        frame,
        body=replace(pose, transl=pose.transl + torch.tensor([0.3, 0.3, 0])),
    )
    gone = replace(
        frame,
        body=replace(pose, transl=pose.transl + torch.tensor([0, 0, 50.0])),
    )
    assert exact > 0.99
    assert body_inside(away, body) < 0.8
    assert body_inside(gone, body) is None
    nobody = replace(frame, mask=torch.zeros_like(frame.mask))
    # a mask that failed tells nothing of the pose
    assert body_inside(nobody, body) is None
    behind = replace(
        frame, skeleton=2 * frame.camera.centre[:, None] - frame.skeleton
    )
    assert body_inside(behind, body) == exact  # whatever the joints say


def test_low_pass_is_the_models_for_F_and_S_whatever_the_accuracy(build):
    _, avatar, _ = build("accuracy=draft")
    assert (
        avatar.accuracy.low_pass
        == avatar.segmentation.accuracy.low_pass
        == 0.0833
    )
    assert avatar.accuracy.name == "draft"
    _, usual, _ = build("model.low_pass=0.3")
    assert (
        usual.accuracy.low_pass == usual.segmentation.accuracy.low_pass == 0.3
    )


@pytest.mark.parametrize("key", ["low_pass", "supersample"])
def test_what_is_the_models_is_not_the_accuracys_too(tiny, key):
    """A word that would change nothing is an error."""
    tiny(f"model.{key}=1")
    with pytest.raises(ConfigCompositionException, match=rf"accuracy\.{key}"):
        tiny(f"accuracy.{key}=1")


@pytest.mark.parametrize(
    ("amount", "maximum"), [(0.15, 1.0), (0.4, 2.5)], ids=["near", "far"]
)
def test_normals_are_those_of_the_posed_mesh_part_by_part(
    body, amount, maximum
):
    """Mean angle to the posed mesh's own normals, degrees; A alone is several times as far off."""
    torch.manual_seed(0)
    pose = replace(
        rest(body, 4), theta=amount * torch.randn(4, len(body.joints), 3)
    )
    placed = BodyPoints(body, 1.7)
    points = placed(pose)
    plain = move_normals(points.frames, placed.rest_normals)
    truth = torch.stack(
        [vertex_normals(means, body.faces) for means in points.means]
    )

    def angle(normals):
        cosine = (functional.normalize(normals, dim=-1) * truth).sum(-1)
        return torch.rad2deg(cosine.clamp(-1, 1).acos())

    found, before = angle(points.normals), angle(plain)
    for label in body.vertex_labels.unique():
        part = body.vertex_labels == label
        assert found[:, part].mean() < maximum, body.label_names[label]
        assert found[:, part].mean() < 0.6 * before[:, part].mean(), (
            body.label_names[label]
        )


def test_the_jacobian_is_that_of_the_learnt_weights(body):
    """Finite differences along edges of the skinned surface, whose weights are not the body's."""
    torch.manual_seed(0)
    placed = BodyPoints(body, 1.7, controls=400)
    with torch.no_grad():
        placed.points.learnt.field.copy_(
            torch.randn_like(placed.points.learnt.field)
        )
        pose = replace(
            rest(body), theta=0.4 * torch.randn(1, len(body.joints), 3)
        )
        points = placed(pose)
        bones = placed.points.with_bones(pose).bones
        own = placed.gradients(
            placed.points.bone_index, placed.points.bone_weight
        )
        wrong = stretch_jacobian(
            points.frames, bones, placed.points.means, *own
        )
    a, b = body.faces[:, 0], body.faces[:, 1]
    edge = (body.vertices[b] - body.vertices[a]).float().unsqueeze(-1)
    moved = points.means[0, b] - points.means[0, a]

    def off(jacobian):
        """Median relative error; the mean of both ends cancels the second order of the step."""
        predicted = ((jacobian[0, a] + jacobian[0, b]) / 2 @ edge).squeeze(-1)
        return (
            (predicted - moved).norm(dim=-1) / edge.norm(dim=1).squeeze()
        ).median()

    assert off(points.stretched) < 0.03
    assert off(points.stretched) < 0.5 * off(wrong)


def test_neighbours_of_a_subset_are_neighbours_on_the_surface(body):
    """Points of two fingers or of two thighs may be near each other, but not along the skin."""
    everything = torch.arange(len(body.vertices))
    edges = torch.cat(
        [body.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]
    )
    edges = torch.cat([edges, edges.flip(1)]).unique(dim=0)
    assert torch.equal(
        neighbours_on_surface(body.vertices, body.faces, everything), edges
    )
    few = BodyPoints(body, 1.7, points=2000).points.chosen
    a, b = neighbours_on_surface(body.vertices, body.faces, few).T
    assert a.unique().numel() >= 1990  # an eye may have one point
    labels = [body.label_names[label] for label in body.vertex_labels]
    sides = {
        (labels[few[i]], labels[few[j]])
        for i, j in zip(a.tolist(), b.tolist(), strict=True)
        if labels[few[i]].startswith("left")
    }
    assert not any(second.startswith("right") for _, second in sides)


def test_the_terms_of_the_stretch_are_renewed_every_so_many_iterations(body):
    points = BodyPoints(
        body, 1.7, points=300, controls=20, stretch_every=3
    ).train()
    pose = BodyPose(torch.zeros(1, len(body.joints), 3), torch.zeros(1, 3))
    field = points.points.learnt.field
    found = []
    for _ in range(5):
        points(pose)
        found.append(points._terms[1])
        with torch.no_grad():
            field += torch.randn(
                field.shape, generator=torch.Generator().manual_seed(0)
            )
    assert found[0] is found[2]
    assert not torch.equal(found[2], found[3])
    assert found[3] is found[4]
    points.renew()
    points(pose)
    assert not torch.equal(points._terms[1], found[4])
    points.eval()
    with torch.no_grad():
        exact = points.gradients(*points.points.weights)[1]
        torch.testing.assert_close(points.stretch_terms()[1], exact)


@pytest.mark.parametrize("model", ["splat_only", "lbs_splat"])
def test_no_gaussian_is_larger_than_two_spacings(tiny, model):
    """However large training makes them: a needle of 10 cm shows in poses far from training."""
    words = [f"model={model}", *([ON] if model == "splat_only" else [])]
    _, module = build_training(tiny(*words))
    avatar = module.avatar.eval()
    joints = avatar.solver.parents
    pose = BodyPose(torch.zeros(1, joints, 3), torch.zeros(1, 3))
    eye = torch.tensor([[0.0, -3.0, 1.0]])
    with torch.no_grad():
        if avatar.surface is not None:
            placed = avatar.surface.points
            avatar.surface.log_scales.fill_(3.0)
            gaussians = avatar.surface(pose, eye)
        else:
            placed = avatar.body_points.points
            psi = avatar.deformation
            psi.table[:, 7:10] = 20.0
            raw = psi._split(psi._active(psi.table)[None])
            gaussians = psi.compose(avatar.body_points(pose), raw, eye)
    largest = torch.linalg.eigvalsh(gaussians.covariances).amax().sqrt()
    limit = 2 * float(placed.spacing.median())
    assert float(largest) == pytest.approx(limit, rel=1e-2)


def test_no_gaussian_is_a_needle_in_200_poses_far_from_training(tiny):
    """The largest that two spacings allow are a quarter longer where skinning stretches most."""
    _, module = build_training(tiny("model=splat_only", ON))
    avatar = module.avatar.eval()
    psi, placed = avatar.deformation, avatar.body_points
    generator = torch.Generator().manual_seed(0)
    size = (200, avatar.solver.parents, 3)
    theta = 0.8 * torch.randn(size, generator=generator)
    eye = torch.tensor([[0.0, -3.0, 1.0]])
    longest = []
    with torch.no_grad():
        psi.table[:, 7:10] = 20.0
        raw = psi._split(psi._active(psi.table)[None])
        for turns in theta:
            pose = BodyPose(turns[None], torch.zeros(1, 3))
            gaussians = psi.compose(placed(pose), raw, eye)
            values = torch.linalg.eigvalsh(gaussians.covariances)
            longest.append(values.amax().sqrt())
    limit = 2 * float(placed.points.spacing.median())
    assert max(longest) <= 1.25 * limit * 1.01
    # Without the limit there are such needles in the same poses.
    placed.stretch_limit = math.inf
    with torch.no_grad():
        pose = BodyPose(theta[:20], torch.zeros(20, 3))
        jacobian = placed(pose).stretched
    assert torch.linalg.matrix_norm(jacobian, ord=2).max() > 2
