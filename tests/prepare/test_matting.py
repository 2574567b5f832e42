"""Cutting a person out of a room that stands still, against known alpha and colours."""

import cv2
import numpy as np
import pytest

from gsgan.prepare.matting import Room, cut_out, study_room, tidy
from gsgan.prepare.sources import Recording

SIZE = (160, 120)
LEVELS = (0.3, 0.8)


def wall(seed: int = 0) -> np.ndarray:
    """A room ``[H, W, 3]`` with large patches of colour and a little noise."""
    rng = np.random.default_rng(seed)
    patches = rng.integers(60, 200, (8, 6, 3)).astype(np.float32)
    room = cv2.resize(patches, SIZE[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(room, 0, 255)


def person(x: float) -> tuple[np.ndarray, np.ndarray]:
    """Colours ``[H, W, 3]`` and soft alpha ``[H, W]`` of an upright ellipse about column ``x``."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    distance = np.hypot((columns - x) / 14, (rows - 85) / 60)
    alpha = np.clip((1 - distance) * 14 + 0.5, 0, 1)
    colour = np.full((*SIZE, 3), (30.0, 40.0, 220.0))
    colour[85:] = (200.0, 60.0, 30.0)
    return colour, alpha


def image_of(room: np.ndarray, x: float) -> tuple[np.ndarray, np.ndarray]:
    colour, alpha = person(x)
    mixed = alpha[..., None] * colour + (1 - alpha[..., None]) * room
    return np.round(mixed).astype(np.uint8), alpha


def rough(alpha: np.ndarray) -> np.ndarray:
    """A segmenter's mask: a pixel off, and a pixel too wide."""
    moved = np.roll(alpha, 1, axis=1)
    wide = cv2.dilate(moved.astype(np.float32), np.ones((3, 3)))
    return np.round(255 * wide).astype(np.uint8)


def difference(alpha: np.ndarray, mask: np.ndarray) -> float:
    return float(np.abs(alpha - mask / 255).sum() / alpha.sum())


def known_room() -> Room:
    room = np.round(wall()).astype(np.uint8)
    return Room(room, np.ones(SIZE, bool))


def test_alpha_and_colours_are_nearer_to_the_truth_than_the_mask():
    image, alpha = image_of(wall(), 60)
    found = cut_out(image, rough(alpha), known_room())
    before = difference(alpha, rough(alpha))
    assert difference(alpha, found.alpha) < 0.4 * before
    true = alpha[..., None] * person(60)[0]
    assert np.abs(found.colour - true).mean() < 1.5
    assert (found.colour <= found.alpha[..., None].astype(int) + 1).all()


def test_a_cast_shadow_is_not_the_person():
    room = wall()
    image, alpha = image_of(room, 60)
    shadow = np.zeros(SIZE, bool)
    shadow[100:140, 74:90] = True
    shadow &= alpha == 0
    image[shadow] = np.round(0.6 * room[shadow])
    found = cut_out(image, rough(alpha), known_room())
    assert found.alpha[shadow].mean() < 10


def test_another_exposure_changes_nothing():
    image, alpha = image_of(wall(), 60)
    darker = np.round(0.8 * image).astype(np.uint8)
    found = cut_out(darker, rough(alpha), known_room())
    assert difference(alpha, found.alpha) < 0.4 * difference(
        alpha, rough(alpha)
    )


def test_where_the_room_is_unknown_or_another_one_the_mask_is_no_worse():
    image, alpha = image_of(wall(), 60)
    before = difference(alpha, rough(alpha))
    unknown = Room(known_room().colour, np.zeros(SIZE, bool))
    other = Room(np.round(wall(seed=5)).astype(np.uint8), np.ones(SIZE, bool))
    for room in (unknown, other):
        found = cut_out(image, rough(alpha), room)
        assert difference(alpha, found.alpha) < before


def test_an_empty_mask_has_nobody():
    image, _ = image_of(wall(), 60)
    found = cut_out(image, np.zeros(SIZE, np.uint8), known_room())
    assert found.alpha.max() == 0
    assert found.colour.max() == 0


@pytest.fixture
def recording(tmp_path):
    """A person who walks through the room, with rough masks."""
    files = {}
    masks = {}
    for frame in range(12):
        image, alpha = image_of(wall(), 20 + 7 * frame)
        files[frame] = tmp_path / f"{frame:06d}.png"
        masks[frame] = tmp_path / f"mask{frame:06d}.png"
        cv2.imwrite(str(files[frame]), image)
        cv2.imwrite(str(masks[frame]), rough(alpha))
    source = Recording(
        name="cam01",
        path=tmp_path,
        size=SIZE,
        fps=None,
        files=files,
        count=len(files),
    )
    return source, masks


def test_the_room_is_found_behind_someone_who_walks(recording):
    source, masks = recording
    studied = study_room(source, masks, range(12), LEVELS)
    assert studied.room is not None
    assert studied.room.seen.mean() > 0.95
    error = np.abs(studied.room.colour - wall())[studied.room.seen]
    assert np.median(error) < 1
    assert np.percentile(error, 99) < 12
    for frame, found in studied.alphas.items():
        assert difference(person(20 + 7 * frame)[1], found) < 0.08


def test_tidying_removes_haze_and_small_pieces():
    mask = np.zeros((40, 40), np.uint8)
    mask[5:30, 5:30] = 255
    mask[35, 35] = 255
    mask[0] = 40
    found = tidy(mask, LEVELS)
    assert found[35, 35] == 0
    assert found[0].max() == 0
    assert found[10, 10] == 255
