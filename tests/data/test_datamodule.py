"""Sampling order, loaders, and what the scene is said to be like."""

import functools
import json
import logging
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from commands import quiet_trainer
from configs import effect_settings
from make import edit_json, skeletons, write_tiny_capture

from gsgan.data.datamodule import (
    GsganData,
    StepSampler,
    count_labels,
    pass_order,
)
from gsgan.data.formats.capture import read_capture
from gsgan.effects import decide
from gsgan.scene import Frame
from gsgan.utils.config import one_sentence
from gsgan.utils.errors import ConfigError, DataError

# isort: split
import lightning
from torch import nn

# --- order --------------------------------------------------------------------------------------


def draws(sampler: StepSampler, epochs: Iterator[int] | range) -> list[int]:
    order = []
    for epoch in epochs:
        sampler.set_epoch(epoch)
        order += list(sampler)
    return order


def test_every_pass_takes_each_item_once_across_epochs():
    order = draws(StepSampler(items=7, batch_size=2, steps=5, seed=3), range(7))
    assert len(order) == 70
    passes = [order[i : i + 7] for i in range(0, 70, 7)]
    assert all(sorted(p) == list(range(7)) for p in passes)
    assert len({tuple(p) for p in passes}) > 5


def test_a_resumed_run_sees_the_order_of_an_unbroken_one():
    whole = draws(StepSampler(7, 2, 5, seed=3), range(6))
    assert draws(StepSampler(7, 2, 5, seed=3), range(4, 6)) == whole[40:]
    assert draws(StepSampler(7, 2, 5, seed=4), range(6)) != whole
    assert torch.equal(pass_order(9, 0, 5), pass_order(9, 0, 5))
    assert not torch.equal(pass_order(9, 0, 5), pass_order(9, 1, 4))


def test_processes_share_the_draws_of_a_step():
    alone = draws(StepSampler(11, 4, 6, seed=0), range(2))
    pair = [
        draws(StepSampler(11, 2, 6, seed=0, replicas=2, rank=r), range(2))
        for r in (0, 1)
    ]
    joined = [
        pair[r][2 * s + i] for s in range(12) for r in (0, 1) for i in (0, 1)
    ]
    assert joined == alone


class Recorder(lightning.LightningModule):
    """Notes which pictures come in which order."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))
        self.seen: list[tuple[int, int]] = []
        self.validated: list[int] = []

    def training_step(self, batch: Frame, index: int) -> torch.Tensor:
        assert isinstance(batch, Frame)
        self.seen += zip(
            batch.camera_index.tolist(), batch.frame_id.tolist(), strict=True
        )
        return self.weight * batch.image.mean()

    def validation_step(
        self, batch: Frame, index: int, dataloader_idx: int = 0
    ) -> None:
        self.validated.append(dataloader_idx)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(
    root: Path, folder: Path, epochs: int, ckpt: Path | None = None
) -> Recorder:
    data = GsganData(
        str(root),
        batch_size=2,
        steps_per_epoch=3,
        seed=5,
        test_cameras=["cam01"],
    )
    model = Recorder()
    trainer = quiet_trainer(folder, max_epochs=epochs)
    trainer.fit(model, datamodule=data, ckpt_path=ckpt)
    trainer.save_checkpoint(folder / "last.ckpt")
    return model


def test_lightning_trains_validates_and_resumes_in_order(ten_frames, tmp_path):
    whole = fit(ten_frames, tmp_path / "whole", 4)
    assert len(whole.seen) == 4 * 3 * 2
    assert (
        len(whole.validated) == 4 * 2
    )  # 4 held-out pictures in twos, every epoch
    assert len(set(whole.seen[:16])) == 16  # 2 cameras × 8 frames, one pass
    first = fit(ten_frames, tmp_path / "part", 2)
    second = fit(
        ten_frames, tmp_path / "part", 4, ckpt=tmp_path / "part" / "last.ckpt"
    )
    assert first.seen + second.seen == whole.seen


# --- the module ---------------------------------------------------------------------------------


def test_loaders_and_datasets(ten_frames):
    data = GsganData(
        str(ten_frames),
        size=16,
        batch_size=2,
        test_cameras=["cam02"],
        crop="person",
    )
    batch = next(iter(data.train_dataloader()))
    assert isinstance(batch, Frame)
    assert batch.image.shape == (2, 3, 16, 16)
    assert len(data.train_dataloader()) == 8  # 2 cameras × 8 frames in twos
    assert data.eval_names == ("novel_view", "novel_pose")
    assert data.reasons == {}
    views, poses = (data.dataset(name) for name in data.eval_names)
    assert {camera for camera, _ in views.items} == {"cam02"}
    assert [frame for _, frame in poses.items] == [8, 9, 8, 9]
    with pytest.raises(
        ValueError, match=r"split.*train, novel_view, novel_pose"
    ):
        data.dataset("test")
    all_trained = GsganData(str(ten_frames), test_share=0)
    assert all_trained.eval_names == ()
    assert set(all_trained.reasons) == {"novel_view", "novel_pose"}


def test_batches_travel_as_bytes_and_become_the_datasets_numbers(tmp_path):
    root = write_tiny_capture(tmp_path / "labelled", labels=True)
    data = GsganData(str(root), size=16, batch_size=2, test_share=0)
    dataset, batch = data.dataset("train"), next(iter(data.train_dataloader()))
    pixels = [batch.image, batch.mask, batch.labels]
    assert [x.dtype for x in pixels] == [torch.uint8] * 3
    on_device = data.transfer_batch_to_device(batch, torch.device("cpu"), 0)
    assert on_device.labels.dtype == torch.int64
    names = data.layout.camera_names
    for i in range(2):
        item = (names[int(batch.camera_index[i])], int(batch.frame_id[i]))
        one = dataset[dataset.items.index(item)]
        for name in ("image", "mask", "labels"):
            assert torch.equal(
                getattr(on_device, name)[i : i + 1], getattr(one, name)
            )


def test_on_a_gpu_batches_are_pinned_and_copied_while_the_host_goes_on(
    ten_frames, monkeypatch
):
    data = GsganData(str(ten_frames), size=16)
    assert not data.train_dataloader().pin_memory
    data.trainer = SimpleNamespace(
        strategy=SimpleNamespace(root_device=torch.device("cuda", 1)),
        world_size=1,
        global_rank=0,
        current_epoch=0,
    )
    assert data.train_dataloader().pin_memory
    frame, moved, pinned, plain = (
        data.dataset("train")[0],
        [],
        [],
        torch.Tensor.to,
    )
    monkeypatch.setattr(
        torch.Tensor, "pin_memory", lambda x: pinned.append(x) or x
    )
    monkeypatch.setattr(
        torch.Tensor,
        "to",
        lambda x, *to, **how: moved.append(how) or plain(x, *to, **how),
    )
    frame = frame.pin_memory()
    assert any(x is frame.image for x in pinned)
    assert any(x is frame.camera.K for x in pinned)
    data.transfer_batch_to_device(frame, torch.device("cpu"), 0)
    assert moved[: len(pinned)] == [{"non_blocking": True}] * len(pinned)


def watched(**keys: Any) -> list[tuple[int, int]]:
    frames = list(GsganData(**keys).val_dataloader())
    return [(int(f.camera_index), int(f.frame_id)) for f in frames]


def test_pictures_watched_while_training_are_spread_over_held_out_poses(
    ten_frames,
):
    keys = {"root": str(ten_frames), "test_frames": "5-9"}
    assert watched(**keys, val_images=99) == [
        (c, f) for c in range(3) for f in range(5, 10)
    ]
    assert watched(**keys, val_images=3) == [(0, 7), (1, 7), (2, 7)]
    # without held-out poses: held-out cameras, and without those: training
    none = {"root": str(ten_frames), "test_share": 0, "val_images": 2}
    assert {c for c, _ in watched(**none, test_cameras=["cam01"])} == {1}
    assert len(watched(**none)) == 2


def test_the_source_is_called_when_data_is_needed_only(ten_frames):
    calls = []

    def make(root: Path) -> Path:
        calls.append(root)
        return root

    data = GsganData(source=functools.partial(make, ten_frames))
    assert calls == []
    data.prepare_data()
    assert calls == [ten_frames]
    assert data.layout.root == ten_frames


def test_notes_reach_the_log(tmp_path, caplog):
    root = write_tiny_capture(tmp_path, frames=4, unit="mm")
    with caplog.at_level(logging.WARNING, logger="gsgan"):
        GsganData(str(root), test_frames=[3, 77]).setup()
    assert "lengths converted from mm to metres" in caplog.text
    assert (
        "1 frames of the splits are not usable or do not exist: 77"
        in caplog.text
    )


def test_scene_info(ten_frames):
    info = GsganData(str(ten_frames), size=24, test_cameras=["cam02"]).info
    assert info.camera_names == ("cam00", "cam01", "cam02")
    assert info.n_train_cameras == 2
    assert not info.has_distortion
    assert info.has_labels
    assert info.n_labels == 3
    assert info.has_body_pose
    assert info.body is None
    assert info.skeleton == "mediapipe33"
    assert info.frames == 8
    expected = skeletons(10)[:8].mean(1)
    assert np.allclose(info.centre, np.median(expected, axis=0), atol=0.02)
    # arms and legs of the stick figure: (0.278 + 0.224 + 0.45 + 0.4) metres a side, hands and feet
    assert 3.0 < info.limb_length_sum < 4.5
    json.dumps(asdict(info))  # plain values, so that a checkpoint can hold it


def test_sides_from_which_cameras_film_the_person(tmp_path):
    root = write_tiny_capture(tmp_path, cameras=4, frames=14)
    one = {"train_cameras": ["cam00"], "test_frames": [12, 13]}
    assert GsganData(str(root), **one).info.degrees_seen <= 60
    assert GsganData(str(root), test_frames=[12, 13]).info.degrees_seen >= 120

    # The person turns by 30 degrees from frame to frame before one camera.
    landmarks = dict(np.load(root / "landmarks3d.npz"))
    for k, joints in enumerate(landmarks["p"]):
        c, s = np.cos(k * np.pi / 6), np.sin(k * np.pi / 6)
        joints[:, :2] = joints[:, :2] @ np.array([[c, s], [-s, c]])
    np.savez(root / "landmarks3d.npz", **landmarks)
    assert GsganData(str(root), **one).info.degrees_seen >= 300


def test_scene_info_sees_the_lens_of_training_cameras_only(tmp_path):
    root = write_tiny_capture(tmp_path, meta={"body": "free"})
    edit_json(
        root / "cameras.json",
        lambda rig: rig["cam01"].update(dist=[0.1, 0, 0, 0]),
    )
    assert GsganData(str(root)).info.has_distortion
    info = GsganData(str(root), test_cameras=["cam01"]).info
    assert not info.has_distortion
    assert not info.has_labels
    assert not info.has_body_pose
    assert info.n_labels == 0
    assert info.body == "free"


def test_the_held_out_split_decides_no_effect(tmp_path):
    """Held-out cameras move nearer, held-out frames change: every decision stays the same."""
    root = write_tiny_capture(tmp_path, cameras=3, frames=10)

    def decisions():
        data = GsganData(str(root), test_cameras=["cam02"], test_share=0.2)
        return asdict(data.info), decide(data.info, effect_settings())

    before = decisions()

    def nearer(rig):
        rig["cam02"]["K"][0][0] *= 1.5
        rig["cam02"]["K"][1][1] *= 1.5

    edit_json(root / "cameras.json", nearer)
    for image in (
        *root.glob("images/cam02/*"),
        *root.glob("images/*/0000[89]*"),
    ):
        cv2.imwrite(str(image), 255 - cv2.imread(str(image)))
    assert decisions() == before


def test_a_capture_may_be_posed_by_the_users_own_smpl_file(tmp_path):
    root = write_tiny_capture(tmp_path, frames=4, meta={"body": "smpl"})
    poses = {
        "theta": np.zeros((4, 24, 3)),
        "transl": np.zeros((4, 3)),
        "frame_id": np.arange(4),
    }
    np.savez(root / "body_pose.npz", **poses, betas=np.array([0.5, -1.0]))
    info = GsganData(str(root), smpl="SMPL_NEUTRAL.pkl").info
    assert (info.body, info.body_file, info.betas) == (
        "smpl",
        "SMPL_NEUTRAL.pkl",
        (0.5, -1.0),
    )
    assert GsganData(str(root)).info.body_file is None
    np.savez(root / "body_pose.npz", **poses, betas=np.array([np.nan]))
    with pytest.raises(DataError, match="betas"):
        GsganData(str(root)).setup()


def test_labels_are_counted_without_the_ignore_value(tmp_path):
    root = write_tiny_capture(tmp_path, cameras=1, frames=2, labels=True)
    cv2.imwrite(
        str(root / "labels/cam00/000001.png"), np.full((24, 32), 255, np.uint8)
    )
    layout = read_capture(root)
    assert count_labels(layout, (("cam00", 0), ("cam00", 1))) == 3
    assert count_labels(layout, (("cam00", 1),)) == 1
    names = write_tiny_capture(
        tmp_path / "n", labels=True, meta={"label_names": list("abcde")}
    )
    assert count_labels(read_capture(names), ()) == 5


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"batch_size": 0},
            r"data\.batch_size.*0",
        ),
        (
            {"steps_per_epoch": 0},
            r"data\.steps_per_epoch",
        ),
        ({"workers": -1}, r"data\.workers"),
        ({"seed": -1}, r"data\.seed"),
        (
            {"cache_mb": "much"},
            r"data\.cache_mb.*'much'",
        ),
        ({"crop": "face"}, r"data\.crop.*'face'"),
        ({"root": None}, r"data\.root"),
    ],
)
def test_config_values_out_of_range(ten_frames, keys, message):
    with pytest.raises(ConfigError, match=message):
        GsganData(**({"root": str(ten_frames)} | keys))


def test_batches_need_one_size(ten_frames):
    GsganData(str(ten_frames), batch_size=2).setup()
    with pytest.raises(ConfigError, match=r"data\.size"):
        GsganData(str(ten_frames), batch_size=2, crop="person").setup()


def test_a_picture_damaged_under_a_worker_process_is_one_sentence(tmp_path):
    root = write_tiny_capture(tmp_path, frames=4)
    data = GsganData(str(root), workers=1)
    data.setup()
    for picture in (root / "images").rglob("*.png"):
        picture.write_bytes(picture.read_bytes()[:60])
    with pytest.raises(DataError, match=r"^Caught DataError") as caught:
        next(iter(data.val_dataloader()))
    said = one_sentence(caught.value) or ""
    assert said.startswith(str(root / "images"))
    assert said.endswith(
        "is damaged or cut off after 60 bytes; copy or export it again"
    )
    assert "\n" not in said
