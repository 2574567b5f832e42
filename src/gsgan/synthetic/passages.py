"""The passages of a motion: the times of a scene's frames, and which frames are held out."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsgan.utils.errors import ConfigError

# The passage of the everyday choreography that never trains.
COMBINATION = "squat_and_wave"
# The signs that never train: a contact, a crossing, and hands before the face.
HELD_OUT = ("roof", "cancel", "peek")


def frame_times(frames: int, duration: float) -> NDArray[np.float64]:
    """``[F]`` seconds: even samples of a motion, in the middle of each step."""
    return (np.arange(frames) + 0.5) * duration / frames


def choose_held_out(
    names: Sequence[str], test_frames: int, block: int = 3
) -> list[int]:
    """The held-out frames: the combination passage first, then blocks inside the others.

    Blocks lie in the middle of passages: their neighbours in time are training frames, the extreme
    of the movement is not. The combination is never in the training split.

    Args:
        names: the passage of each frame.
        test_frames: number of frames to hold out, fewer than all.
        block: frames per block, at least 1.
    """
    combined = []
    others: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if name == COMBINATION:
            combined.append(i)
        else:
            others.setdefault(name, []).append(i)
    chosen = combined[:test_frames]

    # Rounds through the other passages, the longest first, each giving a block per round.
    order = sorted(others.values(), key=len, reverse=True)
    while len(chosen) < test_frames:
        before = len(chosen)
        for run in order:
            free = [i for i in run if i not in chosen]
            # One frame of each passage stays in training as long as possible.
            size = min(block, test_frames - len(chosen), len(free) - 1)
            size = max(size, 0)
            begin = (len(free) - size + 1) // 2
            chosen += free[begin : begin + size]

        # If no passage has a frame to spare, the first free frames are taken.
        if len(chosen) == before:
            left = [i for i in range(len(names)) if i not in chosen]
            chosen += left[: test_frames - len(chosen)]
    return sorted(chosen)


def split_signs(
    names: Sequence[str], test_frames: int
) -> tuple[list[int], list[int]]:
    """Training and held-out frames: signs in `HELD_OUT` are whole in the held-out split.

    Frames of these signs beyond ``test_frames`` are in neither split.

    Args:
        names: the sign of each frame.
        test_frames: number of frames to hold out; 0: all signs train.

    Raises:
        ConfigError: when the signs in `HELD_OUT` have fewer frames.
    """
    # Frames of the held-out signs, and all others.
    unseen = []
    seen = []
    for i, name in enumerate(names):
        if name in HELD_OUT:
            unseen.append(i)
        else:
            seen.append(i)
    if test_frames > len(unseen):
        raise ConfigError(
            f"synthetic data: motion=signs holds out the signs {', '.join(HELD_OUT)}, which have "
            f"{len(unseen)} of {len(names)} frames; test_frames must be at most that"
        )
    if test_frames == 0:
        return list(range(len(names))), []

    # The test frames are spread evenly over those of the held-out signs.
    test = [unseen[k * len(unseen) // test_frames] for k in range(test_frames)]
    return seen, test
