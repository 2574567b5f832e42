"""ZJU-MoCap: trained on and scored."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
import zju_folders

from gsgan.body.smpl_names import CIHP

pytestmark = pytest.mark.usefixtures("model_once")
written = zju_folders.written


def test_the_config_trains_with_segmentation_on_cihp_labels(
    compose, written: Path, smpl_file: Path
) -> None:
    from gsgan.model.runs import build_avatar, build_data

    config = compose(
        "train",
        "size=tiny",
        "training=smoke",
        "data=zju_mocap",
        f"data.root={written}",
        f"data.smpl={smpl_file}",
        "data.size=32",
        "data.reader.drop_frames=3",
    )
    data = build_data(config)
    assert data.layout.frames == (0, 1, 2)
    info = data.info
    assert (info.body, info.n_labels) == ("smpl", 20)
    avatar = build_avatar(config, data).eval()
    assert avatar.segmentation is not None
    painting = avatar.paint(data.dataset("train")[0])
    assert painting.segmentation is not None
    assert "class vote over 9 images" in avatar.segmentation_why
    assert painting.segmentation.shape == (1, avatar.segmentation.classes, 32, 32)
    assert set(avatar.segmentation.map.names) < set(CIHP)
    assert painting.image is not None
    assert torch.isfinite(painting.image).all()


@pytest.mark.slow
def test_a_run_is_scored_with_its_model_file_elsewhere(
    written: Path, smpl_file: Path, tmp_path: Path, inside
) -> None:
    first, now, run = (
        tmp_path / smpl_file.name,
        tmp_path / "moved" / smpl_file.name,
        tmp_path / "run",
    )
    shutil.copy(smpl_file, first)
    trained = inside(
        "train", "size=tiny", "training=smoke", "data=zju_mocap", f"data.root={written}",
        f"data.smpl={first}", "data.size=32", "data.reader.drop_frames=3", f"hydra.run.dir={run}",
    )  # fmt: skip
    assert trained.returncode == 0, trained.stderr
    before = (run / "metrics.json").read_text()
    now.parent.mkdir()
    first.rename(now)
    gone = inside("evaluate", f"run={run}")
    assert gone.returncode != 0
    assert f"{first} does not exist, the body model file of" in " ".join(gone.stderr.split())
    assert "data_smpl=<where it is now>" in " ".join(gone.stderr.split())
    (run / "metrics.json").unlink()
    found = inside("evaluate", f"run={run}", f"data_smpl={now}")
    assert found.returncode == 0, found.stderr
    assert json.loads((run / "metrics.json").read_text()) == json.loads(before)
