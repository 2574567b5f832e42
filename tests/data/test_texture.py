"""Texture that optical flow can follow."""

import numpy as np

from gsgan.data.texture import grey, texture


def test_letters_have_texture_and_plain_cloth_and_stripes_have_none():
    random = np.random.default_rng(0)
    plain = np.full((64, 64, 3), 0.5)
    striped = plain.copy()
    striped[:, ::4] = 0.9
    printed = np.kron(random.random((16, 16, 1)), np.ones((4, 4, 3)))
    assert texture(grey(plain)).max() < 1e-6
    # Stripes tell where a pixel is across, but not along them.
    assert texture(grey(striped))[16:-16, 16:-16].max() < 0.05
    assert texture(grey(printed))[16:-16, 16:-16].min() > 0.8
