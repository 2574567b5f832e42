"""S shows the hand in front where hands cross and touch, against ray-traced labels."""

from pathlib import Path

import numpy as np
import pytest
import torch
from commands import ROOT
from tiny_characters import TINY

from gsgan.body import open_body
from gsgan.data.datamodule import GsganData
from gsgan.model.segmentation import HAND_LABELS, Segmentation
from gsgan.motion.character import Character
from gsgan.synthetic import ensure_scene, scene_setup
from gsgan.synthetic.camera import pixel_rays
from gsgan.synthetic.scene_setup import Scene, SceneSettings
from gsgan.synthetic.trace import Tracer

SIZE = 128
SCENE = TINY | {"motion": "signs", "size": SIZE, "frames": 24, "test_frames": 0}
SCENE |= {"train_cameras": 2, "test_cameras": 0}


def overlaps(scene: Scene, camera: str, frame: int) -> torch.Tensor:
    """``[1, H, W]`` bool: pixels whose ray meets both hands, whatever else is in the way."""
    y, x = np.mgrid[:SIZE, :SIZE]
    eye, rays = pixel_rays(scene.views[camera], x.ravel(), y.ravel(), 1)
    starts, rays = (
        np.tile(eye, (len(rays), 1)).astype(np.float32),
        rays.astype(np.float32),
    )
    character, both = scene.character, np.ones(SIZE * SIZE, bool)
    for name in HAND_LABELS:
        faces = character.faces[
            character.labels == character.label_names.index(name)
        ]
        both &= Tracer(scene.mesh(frame)[0], faces).first(starts, rays)[0] >= 0
    return torch.from_numpy(both.reshape(1, SIZE, SIZE))


@pytest.mark.slow
def test_the_hand_in_front_is_in_front(tmp_path, monkeypatch):
    """With the exact body; docs/sign_language.md has the default person with a fitted one.

    The generator of the signs places hands on this body so that they touch; those of a motion's
    file pass into each other.
    """
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    from motions.posing import Choreography
    from motions.signs import SIGNS

    def signing(character: Character, _path: Path, seed: int) -> Choreography:
        return Choreography(character, seed, SIGNS)

    monkeypatch.setattr(scene_setup, "RecordedMotion", signing)
    root = ensure_scene(cache=tmp_path, workers=1, progress=False, **SCENE)
    scene, data = Scene(SceneSettings(**SCENE)), GsganData(str(root), size=SIZE)
    dataset = data.dataset("train")
    body = open_body("free", label_names=data.info.label_names)
    segmentation = Segmentation(body, mode="hands")
    right = total = 0
    for (camera, number), frame in zip(dataset.items, dataset, strict=True):
        truth = segmentation.truth(frame.labels)
        where = overlaps(scene, camera, int(number)) & (truth > 0)
        if where.any():
            with torch.no_grad():
                S = segmentation(frame.body, frame.camera)
            right += int((1 + S[:, 1:].argmax(1) == truth)[where].sum())
            total += int(where.sum())
    assert total > 800
    assert right > 0.95 * total
