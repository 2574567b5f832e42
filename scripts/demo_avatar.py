"""Makes the avatar and the motion of `gsgan.demo`, in src/gsgan/run/demo.

`python scripts/demo_avatar.py RUN_FOLDER` trains the default person at 256² into RUN_FOLDER; an
interrupted training is continued, a finished one is not repeated. Then it exports the avatar as for
the Hugging Face Hub, and writes the motion: the dance of the default person's choreography.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np

from gsgan.run.shared import DEMO_FOLDER, DEMO_MOTION
from gsgan.synthetic.scene_setup import Scene, SceneSettings

SEED = 0
# Step I with a Gaussian about every pixel of the training images, Ψ at 3,000 of them, and LPIPS.
TRAINING = (
    "experiment=demo_256",
    "model=splat_only",
    "size.body_points=auto",
    "size.anchors=3000",
    "training.step_one.perceptual=0.5",
    "score_images=21",
    f"seed={SEED}",
)
FPS = 25
BEGIN = 27.0  # seconds: the choreography's dance, and the first moves of its free style
END = 31.0


def gsgan(command: str, *words: str) -> None:
    """Runs a command of gsgan."""
    subprocess.run(
        [sys.executable, "-m", f"gsgan.{command}", *words], check=True
    )


def write_motion() -> None:
    """Writes the landmarks of the dance, in the format of `gsgan.prepare`."""
    # A scene with as many frames as the whole choreography has at this rate; nothing is traced.
    seconds = Scene(SceneSettings(frames=2, test_frames=1)).source.duration
    frames = round(seconds * FPS)
    scene = Scene(SceneSettings(frames=frames, seed=SEED))
    _, points = scene.landmarks()
    chosen = (scene.times >= BEGIN) & (scene.times < END)
    p = points[chosen, :75].astype(np.float32)
    np.savez_compressed(DEMO_MOTION, p=p, fps=np.float32(FPS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of the training")
    run = parser.parse_args().run
    gsgan("train", *TRAINING, f"hydra.run.dir={run}")
    gsgan(
        "export",
        f"run={run}",
        "format=hub",
        f"out={DEMO_FOLDER}",
        "overwrite=true",
    )
    write_motion()


if __name__ == "__main__":
    main()
