"""The output of a run while it trains: image grids, progress lines, checkpoints."""

from __future__ import annotations

import io
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import (
    Logger,
    MLFlowLogger,
    TensorBoardLogger,
    WandbLogger,
)
from lightning.pytorch.plugins.io import TorchCheckpointIO
from PIL import Image, ImageOps
from rich.console import Console
from torch import Tensor

from gsgan.evaluate.grids import grid_rows, write_grid
from gsgan.scene import Frame
from gsgan.utils.files import write_atomically

if TYPE_CHECKING:
    from gsgan.data.dataset import CaptureDataset
    from gsgan.train.module import AvatarTraining


SHOWING_IMAGES = (TensorBoardLogger, WandbLogger, MLFlowLogger)
CLIP_FRAMES = 60  # at most
CLIP_MS = 125  # per frame
CLIP_PIXELS = 256  # height of an image, at most


def _training(module: LightningModule) -> AvatarTraining:
    return cast("AvatarTraining", module)


class ImageGrid(Callback):
    """Writes ground truth, Step I's colour, S, I_pred and error at each validation, as
    ``folder/step_000000.png`` with ``rows`` images spread over the validation frames, and sends
    the grid to the loggers that show images."""

    def __init__(self, folder: Path, rows: int = 4) -> None:
        self.folder = folder
        self.rows = rows
        self._collected: list[dict[str, Tensor]] = []

    def on_validation_epoch_start(
        self, trainer: Trainer, module: LightningModule
    ) -> None:
        self._collected = []

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        module: LightningModule,
        outputs: Any,
        batch: Frame,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        # The rows are spread over the validation batches, with one image from a batch.
        stride = max(1, int(sum(trainer.num_val_batches)) // max(1, self.rows))
        if (
            trainer.is_global_zero
            and batch_idx % stride == 0
            and len(self._collected) < self.rows
        ):
            self._collected += grid_rows(batch, outputs)[:1]

    def on_validation_epoch_end(
        self, trainer: Trainer, module: LightningModule
    ) -> None:
        # Only the first process has collected rows.
        if not self._collected:
            return
        step = _training(module).step
        path = self.folder / f"step_{step:06d}.png"
        write_grid(self._collected, path)
        for logger in trainer.loggers:
            send_grid(logger, path, step)


def send_grid(logger: Logger, path: Path, step: int) -> None:
    """Sends a PNG to a logger of TensorBoard, Weights & Biases or MLflow as ``val/grid``."""
    image = Image.open(path)
    match logger:
        case TensorBoardLogger():
            logger.experiment.add_image(
                "val/grid", np.asarray(image), step, dataformats="HWC"
            )
        case WandbLogger():
            logger.log_image("val/grid", [image], step)
        case MLFlowLogger():
            logger.experiment.log_image(
                logger.run_id, image, key="val/grid", step=step
            )


class HeldOutClip(Callback):
    """Sends a clip to the loggers that show images when training ends, as ``val/clip``.

    It shows held-out frames of one camera in their order (training frames where nothing is held
    out), ground truth on the left and the avatar on the right. The file is ``held_out.gif`` in the
    run folder. With other loggers no image is rendered.
    """

    def __init__(self, folder: Path, dataset: CaptureDataset) -> None:
        self.path = folder / "held_out.gif"
        self.dataset = dataset

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:
        loggers = [
            logger
            for logger in trainer.loggers
            if isinstance(logger, SHOWING_IMAGES)
        ]
        if not loggers or not trainer.is_global_zero or not len(self.dataset):
            return

        # The frames of the first camera, rendered as after training and made small.
        module.eval()
        first, _ = self.dataset.items[0]
        places = [
            place
            for place, (camera, _) in enumerate(self.dataset.items)
            if camera == first
        ]
        places.sort(key=lambda place: self.dataset.items[place][1])
        images = [
            self._pair(_training(module), self.dataset[place])
            for place in places[:CLIP_FRAMES]
        ]
        # Images that are cut to the person differ in size, and those of a GIF must not.
        images = [ImageOps.pad(image, images[0].size) for image in images]
        images[0].save(
            self.path,
            save_all=True,
            append_images=images[1:],
            duration=CLIP_MS,
            loop=0,
        )
        for logger in loggers:
            send_clip(logger, self.path, _training(module).step)

    @staticmethod
    @torch.no_grad()
    def _pair(module: AvatarTraining, frame: Frame) -> Image.Image:
        rendering = module.shown(*frame.to(module.device).inputs)
        assert rendering.image is not None
        pair = torch.cat([frame.image, rendering.image.cpu()], dim=3)[0]
        levels = (pair.clamp(0, 1) * 255).round().byte()
        image = Image.fromarray(levels.permute(1, 2, 0).numpy())
        image.thumbnail((2 * CLIP_PIXELS, CLIP_PIXELS))
        return image


def send_clip(logger: Logger, path: Path, step: int) -> None:
    """Sends a GIF to a logger of TensorBoard, Weights & Biases or MLflow as ``val/clip``."""
    match logger:
        case TensorBoardLogger():
            from tensorboard.compat.proto.summary_pb2 import Summary

            # TensorBoard plays a GIF that is encoded already.
            width, height = Image.open(path).size
            image = Summary.Image(
                height=height,
                width=width,
                colorspace=3,
                encoded_image_string=path.read_bytes(),
            )
            value = Summary.Value(tag="val/clip", image=image)
            writer = logger.experiment._get_file_writer()
            writer.add_summary(Summary(value=[value]), step)
        case WandbLogger():
            logger.log_video("val/clip", [str(path)], step, format=["gif"])
        case MLFlowLogger():
            logger.experiment.log_artifact(logger.run_id, path)


class ProgressLines(Callback):
    """Prints a line per validation: iteration, phase, scores, time left."""

    def __init__(self, console: Console) -> None:
        self.console = console

        # When this part of the run began, and at which iteration.
        self._clock = time.monotonic()
        self._first = 0

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        self._clock = time.monotonic()
        self._first = _training(module).step

    def on_validation_end(
        self, trainer: Trainer, module: LightningModule
    ) -> None:
        if not trainer.is_global_zero:
            return
        module = _training(module)

        # The iteration, the phase that was trained last, and the scores.
        step = module.step
        total = module.schedule.total
        scores = trainer.callback_metrics
        line = (
            f"{step:>6}/{total} {module.schedule.phase(max(0, step - 1)):<12}"
        )
        line += f" held-out PSNR {float(scores['val/psnr']):5.2f} dB"
        if module.avatar.generator is not None and "val/psnr_splat" in scores:
            line += f" (Step I's colour {float(scores['val/psnr_splat']):5.2f})"

        # The time left, from the speed of this part of the run.
        done = step - self._first
        if done:
            spent = time.monotonic() - self._clock
            left = spent / done * (total - step)
            line += f"  {done / spent:5.1f} it/s, {left / 60:4.1f} min left"
        self.console.print(line, highlight=False, soft_wrap=True)


class WholeSchedule(Callback):
    """Sets the number of epochs to those that the rest of the schedule takes.

    How long an epoch is depends on the number of processes, which is not known before.
    """

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        training = _training(module)
        left = training.schedule.total - training.step
        epochs = -(-left // int(trainer.num_training_batches))
        trainer.fit_loop.max_epochs = trainer.current_epoch + epochs


class StopOnSignal(Callback):
    """Ends training after the epoch, once its checkpoint is written, if a scheduler asked for it.

    SIGUSR1 and SIGUSR2 ask, which SLURM sends before a job's time is up; from the
    construction on. Lightning installs no handler of its own where there is one.
    """

    def __init__(self) -> None:
        self.asked = False

        # Systems without these signals have no such scheduler.
        for name in ("SIGUSR1", "SIGUSR2"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), self._ask)

    def _ask(self, *_: Any) -> None:
        self.asked = True

    def on_train_epoch_end(
        self, trainer: Trainer, module: LightningModule
    ) -> None:
        # over all processes, which need not have had the signal in the same epoch
        self.asked = trainer.strategy.reduce_boolean_decision(
            self.asked, all=False
        )
        trainer.should_stop |= self.asked


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes a new file and renames it, so that a killed run leaves a whole checkpoint.

    Lightning itself writes those at addresses such as s3://bucket/run.
    """

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: Any,
        storage_options: Any | None = None,
    ) -> None:
        if "://" in str(path):
            super().save_checkpoint(checkpoint, path, storage_options)
            return

        # The checkpoint is complete in memory before a file is touched.
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_atomically(Path(path), buffer.getvalue())
