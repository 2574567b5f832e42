"""Reader of THuman4.0.

::

    calibration.json        {cam00: {K 9, R 9, T 3, imgSize [w, h]}}, metres
    images/cam00/%08d.jpg   masks/cam00/%08d.jpg    matting alphas
    smpl_params.npz         SMPL-X, row i = frame i
    missing_img_files.txt   images to leave out, one per line
"""

from typing import ClassVar

from gsgan.data.formats.smplx_rig import SmplxRigReader


class Thuman4Reader(SmplxRigReader):
    """Reads a subject of THuman4.0; settings as `SmplxRigReader`."""

    contents: ClassVar[str] = (
        "calibration.json, smpl_params.npz, images/ and masks/"
    )
    layout: ClassVar[str] = "THuman4.0"
    calibration: ClassVar[str] = "calibration.json"
    images: ClassVar[str] = "images/{camera}"
    masks: ClassVar[str] = "masks/{camera}"
