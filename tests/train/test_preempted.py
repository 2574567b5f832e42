"""A scheduler's signal ends training after a checkpoint, and the same command goes on."""

import os
import signal

import pytest
import torch
from commands import TINY

from gsgan.train.module import AvatarTraining
from gsgan.utils.sweeps import STOPPED

SLURM = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "1", "SLURM_NTASKS_PER_NODE": "1",
         "SLURM_JOB_NAME": "gsgan", "SLURM_PROCID": "0", "SLURM_LOCALID": "0",
         "SLURM_NODEID": "0", "SLURM_NODELIST": "here"}  # fmt: skip


@pytest.fixture
def asked_at(monkeypatch):
    """``asked_at(5)``: SIGUSR1 in that iteration; afterwards the handlers are as before."""
    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGUSR1, signal.SIGUSR2)
    }
    step, handlers = AvatarTraining.training_step, []

    def run(number: int):
        def signalled(module, *batch):
            if module.step == number:
                handlers.append(signal.getsignal(signal.SIGUSR1))
                os.kill(os.getpid(), signal.SIGUSR1)
            return step(module, *batch)

        monkeypatch.setattr(AvatarTraining, "training_step", signalled)
        return handlers

    yield run
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_preempted_run_ends_with_the_same_weights(
    capture, tmp_path, inside, asked_at
):
    def train(name: str):
        given = (
            "model=splat_only",
            "evaluate=false",
            "trainer=cpu",
            f"data.root={capture}",
        )
        result = inside(
            "train", *TINY, *given, f"hydra.run.dir={tmp_path / name}"
        )
        path = tmp_path / name / "checkpoints" / "last.ckpt"
        return result, torch.load(path, weights_only=True)

    whole, expected = train("whole")
    assert whole.returncode == 0, whole.stderr
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SLURM.items():
            patch.setenv(name, value)
        handlers = asked_at(5)
        stopped, state = train("stopped")
    assert stopped.returncode == STOPPED, stopped.stderr
    # the end of its epoch
    assert "stopped by a signal at iteration 8" in stopped.stdout
    assert state["gsgan"]["step"] == 8
    assert "StopOnSignal" in str(
        handlers[0]
    )  # Lightning's requeueing left it in place
    resumed, found = train("stopped")
    assert resumed.returncode == 0, resumed.stderr
    assert found["gsgan"]["step"] == expected["gsgan"]["step"] > 8
    for name, value in expected["state_dict"].items():
        assert torch.equal(found["state_dict"][name], value), name
