"""Pixels that are not to be learned from: no loss and no gradient there, the same elsewhere."""

import torch

from gsgan.losses.photometric import photometric, without_unsure


def pictures() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 2, 3, 16, 16, generator=generator)
    unsure = torch.zeros(2, 1, 16, 16)
    unsure[:, :, 4:9] = 1
    return image.requires_grad_(), target, unsure


def test_pixel_losses_are_those_of_the_sure_pixels_alone():
    image, target, unsure = pictures()
    photometric(image, target, l1=0.5, l2=0.3, ssim=0, unsure=unsure).backward()
    sure = (1 - unsure).expand_as(image)
    difference = (image - target).detach() * sure
    expected = (0.5 * difference.sign() + 0.6 * difference) / difference.numel()
    torch.testing.assert_close(image.grad, expected)


def test_nothing_changes_without_them():
    image, target, unsure = pictures()
    assert without_unsure(target, image, None) is target
    assert photometric(image, target, unsure=0 * unsure) == photometric(
        image, target
    )
