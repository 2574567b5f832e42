"""Generator, discriminator, pose encoders, encoding: shapes, starts, gradients, hard inputs."""

import pytest
import torch
from torch.nn import functional

from gsgan.model.deformation import encoding_size, positional_encoding
from gsgan.model.discriminator import Discriminator
from gsgan.model.generator import Generator, StyleModulation, upsampling_kernel
from gsgan.model.pose_graph import PoseGraph, PoseLinear
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.errors import ConfigError


def generator(**options) -> Generator:
    return Generator(5, 4, 8, 35, base=4, **options)


def inputs(height: int, width: int, batch: int = 2):
    torch.manual_seed(0)
    F = torch.rand(batch, 5, height, width)
    S = torch.rand(batch, 4, height, width)
    return F, S, torch.rand(batch, 8, height, width), torch.randn(batch, 35)


def test_generator_sees_what_supersampling_averages():
    F, S, p2d, g = inputs(17, 12)
    net = Generator(5, 4, 8, 35, 2, base=4)
    assert (
        net.content.stem.in_channels
        == generator().content.stem.in_channels + 4 * 5
    )
    fine = torch.rand(2, 5, 34, 24, requires_grad=True)
    image = net(F, S, p2d, g, fine)
    assert image.shape == (2, 4, 17, 12)
    assert not torch.equal(image, net(F, S, p2d, g, 1 - fine))
    image.square().mean().backward()
    assert torch.isfinite(fine.grad).all()
    assert (fine.grad != 0).any()


@pytest.mark.parametrize("times", [2, 3])
def test_the_stem_on_fine_pixels_is_the_stem_on_their_averages_and_channels(
    times,
):
    """Of a window whose sides are multiples of the stride, and of one that is padded."""
    F, S, p2d, _ = inputs(16, 11)
    net = Generator(5, 4, 8, 35, times, base=4)
    fine = torch.randn(2, 5, 16 * times, 11 * times)
    F = functional.avg_pool2d(fine, times)
    content = torch.cat(
        [F, S, p2d, functional.pixel_unshuffle(fine, times)], dim=1
    )
    plain = net.content.stem(functional.pad(content, (0, 5)))
    quick = net._stem(net._pad(F), [S, p2d], fine)
    torch.testing.assert_close(quick, plain, atol=1e-5, rtol=1e-5)


def test_a_transposed_convolution_is_a_convolution_after_upsampling():
    weight, h = torch.randn(3, 5, 3, 3), torch.randn(2, 5, 4, 7)
    plain = functional.conv2d(
        functional.interpolate(h, scale_factor=2.0, mode="nearest"),
        weight,
        padding=1,
    )
    quick = functional.conv_transpose2d(
        h, upsampling_kernel(weight), stride=2, padding=1
    )
    torch.testing.assert_close(quick, plain, atol=1e-5, rtol=1e-5)


def test_generator_refuses_a_fine_F_it_was_not_built_for():
    F, S, p2d, g = inputs(16, 12)
    net = Generator(5, 4, 8, 35, 2, base=4)
    with pytest.raises(ValueError, match=r"fine.*\(32, 24\).*None"):
        net(F, S, p2d, g)
    with pytest.raises(ValueError, match=r"fine.*\(32, 24\).*\(48, 36\)"):
        net(F, S, p2d, g, torch.zeros(2, 5, 48, 36))
    with pytest.raises(ValueError, match=r"fine.*None.*\(32, 24\)"):
        generator()(F, S, p2d, g, torch.zeros(2, 5, 32, 24))


def test_generator_with_rgb_skip_starts_at_step_one_colour_and_alpha():
    F, S, p2d, g = inputs(16, 16)
    alpha = torch.rand(2, 1, 16, 16)
    painted = generator(rgb_skip=True)(F, S, p2d, g, alpha=alpha)
    torch.testing.assert_close(
        painted, torch.cat([F[:, :3], alpha], 1), rtol=0, atol=0
    )
    with pytest.raises(ValueError, match=r"rgb_skip=True.*alpha"):
        generator(rgb_skip=True)(F, S, p2d, g)


def test_generator_uses_every_input():
    """Each of F, S, p2D and g moves the picture once the style has left its zero start."""
    torch.manual_seed(1)
    net = generator()
    for style in [m for m in net.modules() if isinstance(m, StyleModulation)]:
        torch.nn.init.normal_(style.from_pose.weight, std=0.1)
        torch.nn.init.normal_(style.from_map.weight, std=0.1)
    given = [x.requires_grad_() for x in inputs(16, 16)]
    net(*given).square().sum().backward()
    assert all(
        x.grad is not None and float(x.grad.abs().max()) > 0 for x in given
    )


def test_style_starts_as_plain_normalisation():
    style = StyleModulation(6, 3, 35)
    h = torch.randn(1, 6, 4, 4)
    out = style(h, torch.randn(1, 3, 4, 4), torch.randn(1, 35))
    plain = torch.where(out < 0, out / 0.2, out)  # before the activation
    torch.testing.assert_close(
        plain.square().mean(1), torch.ones(1, 4, 4), atol=1e-4, rtol=0
    )
    assert torch.isfinite(
        style(h * 0, torch.randn(1, 3, 4, 4), torch.randn(1, 35))
    ).all()


def test_the_style_of_a_batch_is_that_of_each_image():
    style = StyleModulation(6, 3, 35)
    torch.nn.init.normal_(style.from_map.weight)
    torch.nn.init.normal_(style.from_pose.weight)
    given = torch.randn(2, 6, 4, 5), torch.randn(2, 3, 4, 5), torch.randn(2, 35)
    each = [style(*(x[i : i + 1] for x in given)) for i in range(2)]
    torch.testing.assert_close(style(*given), torch.cat(each))


def test_discriminator_judges_every_scale():
    maps = Discriminator(scales=2, base=4, layers=3)(torch.rand(2, 3, 32, 32))
    assert len(maps) == 2
    assert [len(scale) for scale in maps] == [
        4,
        4,
    ]  # three feature maps and the logits
    assert maps[0][-1].shape[1] == 1
    assert maps[0][0].shape[-1] == 2 * maps[1][0].shape[-1]


@pytest.mark.parametrize("norm", ["instance", "none"])
def test_discriminator_refuses_pictures_that_normalisation_would_erase(norm):
    judge = Discriminator(scales=2, base=4, layers=4, norm=norm)
    with pytest.raises(ValueError, match="too small"):
        judge(torch.rand(1, 3, 16, 16))


def test_a_judge_without_normalisation_sees_contrast():
    """Instance normalisation hides it: what a judge of nearly right pictures needs."""
    torch.manual_seed(0)
    # so that normalisation's own epsilon does not show
    image = 100 * torch.randn(1, 3, 32, 32)
    for norm, sees in (("none", True), ("instance", False)):
        judge = Discriminator(scales=1, base=4, layers=3, norm=norm)
        sharp, soft = judge(image)[0][-1], judge(0.5 * image)[0][-1]
        assert (
            float((sharp - soft).abs().max()) > 0.01 * float(sharp.std())
        ) is sees
    with pytest.raises(ConfigError, match=r"norm.*instance, none"):
        Discriminator(norm="batch")


def test_pose_graph_spreads_along_edges_only():
    """Two graph layers: the left hand cannot reach the right foot's number."""
    torch.manual_seed(0)
    graph = PoseGraph(width=8, joint_channels=4, octaves=1)
    omega = torch.randn(1, 33, 6, requires_grad=True)
    g = graph(omega, torch.zeros(1, 33, 3))
    assert g.shape == (1, 35)
    edge = MEDIAPIPE33.edges.index((30, 32))
    g[0, edge].backward()
    touched = omega.grad.abs().sum(-1)[0] > 0
    assert bool(touched[32])
    assert not bool(touched[19])


def test_pose_linear_has_the_papers_size():
    """g = W p + b: 99 x 35 + 35 numbers."""
    linear = PoseLinear()
    assert sum(p.numel() for p in linear.parameters()) == 99 * 35 + 35
    assert linear(torch.zeros(2, 33, 6), torch.randn(2, 33, 3)).shape == (2, 35)


def test_positional_encoding_values():
    x = torch.tensor([[0.25, -0.5]])
    code = positional_encoding(x, 2)
    assert code.shape[-1] == encoding_size(2, 2)
    expected = torch.tensor(
        [0.25 * torch.pi, 0.5 * torch.pi, -0.5 * torch.pi, -torch.pi]
    ).sin()
    torch.testing.assert_close(code[0, 2:6], expected)
    assert positional_encoding(x, 0) is x


@pytest.mark.parametrize("times", [1, 2])
def test_a_generator_of_patches(times):
    F, S, p2d, g = inputs(20, 12)
    net = Generator(5, 4, 8, 35, times, base=4, patch=2)
    fine = None if times == 1 else torch.rand(2, 5, 20 * times, 12 * times)
    F = F if fine is None else functional.avg_pool2d(fine, times)
    assert net(F, S, p2d, g, fine).shape == (2, 4, 20, 12)
    assert len(net.up) == len(generator().up) - 1
    given = [net._pad(x) for x in (F, S, p2d)]
    if fine is not None:
        given.append(functional.pixel_unshuffle(net._pad(fine, times), times))
    plain = net.content.stem(torch.cat(given, dim=1))
    torch.testing.assert_close(
        net._stem(given[0], [S, p2d], fine), plain, atol=1e-5, rtol=1e-5
    )
    with pytest.raises(ConfigError, match=r"patch.*1, 2, 4"):
        generator(patch=3)


def test_a_refinement_ends_a_generator_of_patches():
    """It starts at Step I's image, paints any size, and all of it learns."""
    F, S, p2d, g = inputs(21, 13)
    alpha = torch.rand(2, 1, 21, 13)
    net = Generator(5, 4, 8, 35, base=4, patch=2, refine=True, rgb_skip=True)
    first = torch.cat([F[:, :3], alpha], dim=1)
    torch.testing.assert_close(net(F, S, p2d, g, alpha=alpha), first)

    torch.nn.init.normal_(net.paint.weight, std=0.1)
    painted = net(F, S, p2d, g, alpha=alpha)
    assert painted.shape == first.shape
    painted.square().sum().backward()
    for parameter in net.refinement.parameters():
        assert bool(parameter.grad.abs().sum() > 0)


@pytest.mark.parametrize("skip", [False, True])
def test_the_image_has_all_its_digits_under_bf16(skip):
    """The last layer in bfloat16 would round the image to 8 bits of mantissa."""
    net = generator(rgb_skip=skip)
    torch.nn.init.normal_(net.paint.weight, std=0.1)
    F, S, p2d, g = inputs(16, 16)
    alpha = torch.rand(2, 1, 16, 16)
    with torch.autocast("cpu", torch.bfloat16):
        image = net(F, S, p2d, g, alpha=alpha)
    assert image.dtype == torch.float32
    assert not torch.equal(image, image.bfloat16().float())
