"""Pixels that are not to be learned from: no loss and no gradient there, the same elsewhere."""

import torch

from gsgan.losses.photometric import photometric, without_ignored


def pictures() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 2, 3, 16, 16, generator=generator)
    ignored = torch.zeros(2, 1, 16, 16)
    ignored[:, :, 4:9] = 1
    return image.requires_grad_(), target, ignored


def test_pixel_losses_are_those_of_the_sure_pixels_alone():
    image, target, ignored = pictures()
    photometric(
        image, target, l1=0.5, l2=0.3, ssim=0, ignored=ignored
    ).backward()
    sure = (1 - ignored).expand_as(image)
    difference = (image - target).detach() * sure
    expected = (0.5 * difference.sign() + 0.6 * difference) / difference.numel()
    torch.testing.assert_close(image.grad, expected)


def test_nothing_changes_without_them():
    image, target, ignored = pictures()
    assert without_ignored(target, image, None) is target
    assert photometric(image, target, ignored=0 * ignored) == photometric(
        image, target
    )
