"""THuman4.0 on disk."""

from pathlib import Path

from writers.smplx_rig import SmplxSubject, write_rig


def write_thuman4(
    root: Path,
    subject: SmplxSubject,
    missing: tuple[str, ...] = (),
    **lens: list[float],
) -> Path:
    """subject00 and its like; ``lens``: further keys of each camera in calibration.json."""
    names = [f"cam{i:02d}" for i in range(len(subject.cameras))]
    root.mkdir(parents=True)
    write_rig(
        root,
        subject,
        names,
        "calibration.json",
        "images/{}",
        "masks/{}",
        dict(lens),
    )
    (root / "missing_img_files.txt").write_text(
        "".join(f"{line}\r\n" for line in missing)
    )
    return root
