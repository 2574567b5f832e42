"""A two-alternative test on crops: which of two images is nearer to the truth?

    python scripts/bench/two_alternatives.py build/test runs/study/<a run> runs/study/<another>
    python scripts/bench/two_alternatives.py build/test runs/study/<a run>
    python scripts/bench/two_alternatives.py build/test --answers answers.txt

Draws pages of crops of held-out images, magnified: the truth in the middle, the two runs left and
right. Of a single run its image is compared with its own Step I's colour. A crop is where the two
differ most, chosen without the truth. Every pair comes twice, sides exchanged, in random order, and
counts only where both answers name the same run: who prefers a side chooses nothing.
``order.json`` holds the order: do not read it before judging. ``answers.txt`` has a line per row:
its number and left, right or equal.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from scipy.stats import binomtest
from torch import Tensor
from torch.nn import functional

from gsgan.report.figures.run import most_disputed
from gsgan.report.figures.subjects import (
    Shot,
    Subject,
    choose_items,
    make_shots,
    open_subjects,
)
from gsgan.run.stored import DataPaths

MARGIN = 0.1  # metres beyond the joints that the images show
SHARE = 0.3  # of their sides that a crop shows
HEIGHT = 480  # pixels of a magnified crop
GAP = 8  # pixels between crops
ROWS = 3  # per page
NAMES = ("left", "right", "equal")


def step_one(subject: Subject, shot: Shot) -> Tensor:
    """``[1, 3, h, w]`` Step I's colour as shown."""
    with torch.no_grad():
        colour = subject.avatar(*shot.frame.inputs).colour
    assert colour is not None, f"{subject.run.folder} splats nothing"
    return shot.window.cut(colour).clamp(0, 1)


def magnified(crop: Tensor) -> np.ndarray:
    """``[1, 3, h, w]`` in [0, 1] to a byte image of HEIGHT, bicubic."""
    factor = HEIGHT / crop.shape[-2]
    size = HEIGHT, round(crop.shape[-1] * factor)
    large = functional.interpolate(crop, size=size, mode="bicubic").clamp(0, 1)
    return (255 * large[0].permute(1, 2, 0)).round().byte().numpy()


def row(number: int, images: list[np.ndarray]) -> np.ndarray:
    """Crops side by side with the pair's number."""
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    strip = np.hstack([x for image in images for x in (gap, image)])
    page = Image.fromarray(
        np.vstack([np.full((20, strip.shape[1], 3), 255, np.uint8), strip])
    )
    ImageDraw.Draw(page).text(
        (GAP, 4), f"{number}      left | truth | right", fill=(0, 0, 0)
    )
    return np.asarray(page)


def draw(
    folder: Path, runs: list[Path], pairs: int, split: str, seed: int
) -> None:
    """Writes pages and order.json."""
    subjects = open_subjects(runs, DataPaths(), "cpu")
    first, second = subjects[0], subjects[-1]
    items = choose_items(
        first.data, split, frames=None, camera=None, count=pairs
    )
    shots = make_shots(first.data, split, items, MARGIN)
    shown = np.random.default_rng(seed).permutation(2 * len(shots)).tolist()
    rows = []
    for number, place in enumerate(shown, 1):
        shot, swap = shots[place // 2], place % 2
        a = first.image(shot)
        b = step_one(first, shot) if len(runs) == 1 else second.image(shot)
        box = most_disputed(torch.cat([a, b]), SHARE)
        left, right = (b, a) if swap else (a, b)
        rows.append(
            row(
                number,
                [magnified(x[..., *box]) for x in (left, shot.truth, right)],
            )
        )
    folder.mkdir(parents=True, exist_ok=True)
    width = max(x.shape[1] for x in rows)
    rows = [
        np.pad(
            x, ((0, 0), (0, width - x.shape[1]), (0, 0)), constant_values=255
        )
        for x in rows
    ]
    for page in range(0, len(rows), ROWS):
        name = folder / f"page_{page // ROWS + 1:02d}.png"
        Image.fromarray(np.vstack(rows[page : page + ROWS])).save(name)
    names = [
        str(runs[0]),
        str(runs[1]) if len(runs) == 2 else "its Step I's colour",
    ]
    (folder / "order.json").write_text(
        json.dumps({"runs": names, "rows": shown})
    )


def count(folder: Path, answers: Path) -> None:
    """Prints how often each was chosen twice, and the chance of that if they were equal."""
    order = json.loads((folder / "order.json").read_text())
    lines = dict(
        line.split()
        for line in answers.read_text().splitlines()
        if line.strip()
    )
    rows = {str(i): place for i, place in enumerate(order["rows"], 1)}
    if set(lines) != set(rows) or not set(lines.values()) <= set(NAMES):
        raise SystemExit(
            f"{answers}: expected lines '1 left' to '{len(rows)} equal'"
        )
    chosen: dict[int, set[int | None]] = {}
    for number, place in rows.items():
        side = NAMES.index(lines[number])
        chosen.setdefault(place // 2, set()).add(
            None if side == 2 else side ^ place % 2
        )
    wins = [sum(found == {run} for found in chosen.values()) for run in (0, 1)]
    for name, won in zip(order["runs"], wins, strict=True):
        print(f"{name}: {won} of {len(chosen)}")
    undecided = len(chosen) - sum(wins)
    print(
        f"undecided: {undecided}; p = {binomtest(wins[0], sum(wins) or 1).pvalue:.2g}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "runs", type=Path, nargs="*", help="one or two run folders"
    )
    parser.add_argument("--answers", type=Path)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--split", default="novel_pose")
    parser.add_argument("--seed", type=int, default=0)
    words = parser.parse_args()
    if words.answers is not None:
        count(words.folder, words.answers)
    elif len(words.runs) in (1, 2):
        draw(words.folder, words.runs, words.pairs, words.split, words.seed)
    else:
        parser.error("give one or two run folders, or --answers")
