"""A full disk: one sentence that names the file, and the last good state stays."""

import errno
import os

import pytest
import torch
from commands import TINY

from gsgan.utils.files import write_atomically


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_file_that_does_not_fit_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "scores.json"
    write_atomically(path, "old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"scores\.json"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_training_on_a_full_disk_ends_in_one_sentence_and_is_resumed(
    capture, tmp_path, inside, monkeypatch
):
    """It is full from the second checkpoint on, and later from Hydra's first file on."""
    run, sync, calls = tmp_path / "run", os.fsync, []

    def fills_up(file: int) -> None:
        calls.append(file)
        full() if len(calls) > 3 else sync(file)

    given = [
        *TINY,
        f"data.root={capture}",
        f"hydra.run.dir={run}",
        "evaluate=false",
    ]
    monkeypatch.setattr(os, "fsync", fills_up)
    result = inside("train", *given)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert (
        "cannot be written (No space left on device): make room"
        in result.stderr
    )
    kept = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)[
        "gsgan"
    ]["step"]
    assert 0 < kept < 16
    monkeypatch.setattr("hydra.core.utils._save_config", full)
    assert "cannot be written (No space" in inside("train", *given).stderr
    monkeypatch.undo()
    assert inside("train", *given).returncode == 0
    assert (
        torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)[
            "gsgan"
        ]["step"]
        == 16
    )
