"""AvatarReX: where it differs from THuman4.0 (tests of what they share are in test_thuman4)."""

from pathlib import Path

import pytest
from capture_frames import check_cameras, check_images, check_skeletons
from writers.avatarrex import SERIALS, write_avatarrex

from gsgan.data.formats.avatarrex import AvatarrexReader
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds

pytestmark = pytest.mark.usefixtures("model_once")


def read(root: Path, smplx: Path) -> Layout:
    return AvatarrexReader()(root, Thresholds(), str(smplx))


@pytest.fixture
def root(tmp_path, smplx_subject):
    return write_avatarrex(tmp_path / "avatarrex_zzr", smplx_subject)


def test_read_equals_written(root, smplx_subject, smplx_file):
    layout = read(root, smplx_file)
    # a lens of zeros and a list that is not there need no note
    assert layout.notes == ()
    # the calibration's order, which indices count
    assert layout.camera_names == SERIALS
    s = smplx_subject
    check_cameras(layout, s.cameras)
    for name in SERIALS:
        assert layout.image_path(name, 1) == root / name / "00000001.jpg"
        assert (
            layout.mask_path(name, 1) == root / name / "mask/pha/00000001.jpg"
        )
    check_images(layout, s)
    check_skeletons(layout, s, "smplx")
    assert layout.meta.layout == "AvatarReX"


def test_the_list_of_missing_files_is_optional_and_names_serials(
    root, smplx_file
):
    (root / "missing_img_files.txt").write_text(
        f"D:\\avatarrex_zzr\\{SERIALS[1]}\\00000002.jpg\n{SERIALS[0]}/mask/pha/00000000.jpg\n"
    )
    layout = read(root, smplx_file)
    assert list(layout.images[SERIALS[1]]) == [0, 1, 3]
    assert list(layout.images[SERIALS[0]]) == [1, 2, 3]
