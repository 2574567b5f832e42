"""AvatarReX on disk."""

from pathlib import Path

from writers.smplx_rig import SmplxSubject, write_rig

# not sorted: the calibration's order counts
SERIALS = ("22139911", "22010708", "22053927")


def write_avatarrex(root: Path, subject: SmplxSubject) -> Path:
    """avatarrex_zzr and its like; calibration by serial, with keys that are not needed."""
    lens = {"distCoeff": [0.0] * 5, "rectifyAlpha": 0.0}
    root.mkdir(parents=True)
    write_rig(
        root,
        subject,
        SERIALS,
        "calibration_full.json",
        "{}",
        "{}/mask/pha",
        lens,
    )
    return root
