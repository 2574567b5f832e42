"""Runs commands as a user does, for the tests of entry points."""

import importlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
TINY = [
    "size=tiny",
    "training=smoke",
    "data=capture",
    "data.size=32",
    "data.crop=null",
]
TINY += ["lpips.nets=[]"]  # the networks take longer than the training


# One thread: sums are rounded in another order with another number of threads.
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "120"}


def gsgan(
    command: str,
    *args: str,
    cwd: Path,
    timeout: int = 300,
    environment: dict = ENVIRONMENT,
):
    """Runs ``python -m gsgan.<command>`` from another directory, as an installed user would."""
    return subprocess.run(
        [sys.executable, "-m", f"gsgan.{command}", *args],
        cwd=cwd, env=environment, capture_output=True, text=True, timeout=timeout,
    )  # fmt: skip


def train(capture: Path, run: Path, *args: str):
    return gsgan("train", *arguments(capture, run), *args, cwd=run.parent)


def arguments(capture: Path, run: Path) -> list[str]:
    """The overrides of a tiny training run."""
    return [*TINY, f"data.root={capture}", f"hydra.run.dir={run}"]


def refused(result, *words: str) -> None:
    """A message with these words on stderr, a non-zero exit status, no traceback."""
    assert result.returncode != 0, result.stdout
    assert "Traceback" not in result.stderr + result.stdout
    text = " ".join(result.stderr.split())
    for word in words:
        assert word in text, text


def quiet_trainer(folder: Path, **options):
    """A trainer on the CPU that writes and shows nothing."""
    from lightning import Trainer

    off = (
        "logger",
        "enable_checkpointing",
        "enable_progress_bar",
        "enable_model_summary",
    )
    given = {"accelerator": "cpu", "num_sanity_val_steps": 0} | dict.fromkeys(
        off, False
    )
    return Trainer(default_root_dir=folder, **(given | options))


def stored(module, folder):
    """The run folder of a training that has just begun."""
    import torch  # here: other tests need commands alone

    from gsgan.run.stored import CHECKPOINT

    checkpoint = {"state_dict": module.state_dict()}
    module.on_save_checkpoint(checkpoint)
    (folder / CHECKPOINT).parent.mkdir()
    torch.save(checkpoint, folder / CHECKPOINT)


def entry_module(command: str) -> str:
    """The module that ``python -m gsgan.<command>`` runs."""
    name = f"gsgan.{command}"
    spec = importlib.util.find_spec(name)
    return (
        name
        if spec is None or spec.submodule_search_locations is None
        else f"{name}.__main__"
    )


def forked(command: list[str]) -> int:
    """The exit status of a sweep's job, run by a child that has imported everything already."""
    from hydra.core.global_hydra import GlobalHydra

    sys.stdout.flush()
    child = os.fork()
    if not child:
        GlobalHydra.instance().clear()  # the sweep's
        sys.argv, code = [command[2], *command[3:]], 1
        try:
            importlib.import_module(
                entry_module(command[2].removeprefix("gsgan."))
            ).main()
            code = 0
        except SystemExit as end:
            code = (
                end.code
                if isinstance(end.code, int)
                else int(end.code is not None)
            )
        finally:
            sys.stdout.flush()
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
