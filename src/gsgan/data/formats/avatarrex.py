"""Reader of AvatarReX.

::

    calibration_full.json   {serial: {K 9, R 9, T 3, imgSize [w, h]}}, metres
    {serial}/%08d.jpg       {serial}/mask/pha/%08d.jpg    matting alphas
    smpl_params.npz         SMPL-X, row i = frame i
    missing_img_files.txt   optional: images to leave out, one per line
"""

from typing import ClassVar

from gsgan.data.formats.smplx_rig import SmplxRigReader


class AvatarrexReader(SmplxRigReader):
    """Reads a subject of AvatarReX; settings as `SmplxRigReader`."""

    contents: ClassVar[str] = (
        "calibration_full.json, smpl_params.npz and a folder for each camera"
    )
    layout: ClassVar[str] = "AvatarReX"
    calibration: ClassVar[str] = "calibration_full.json"
    images: ClassVar[str] = "{camera}"
    masks: ClassVar[str] = "{camera}/mask/pha"
