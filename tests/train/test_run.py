"""What a run does before it trains: its folder, its device."""

from dataclasses import replace

import pytest
import torch
from lightning import Trainer

from gsgan.train.resume import remove_old_results
from gsgan.train.trainer import TrainerFactory


def test_starting_over_removes_an_earlier_runs_results_and_logs(tmp_path):
    for name in ("logs", "logs_000150"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text(
            "step,val/psnr,val/seconds\n1,20,3\n"
        )
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("mine")
    remove_old_results(tmp_path)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [
        "notes.txt"
    ]


@pytest.mark.parametrize("launcher", ["LOCAL_RANK", "SLURM_LOCALID"])
@pytest.mark.parametrize(("devices", "expected"), [("auto", 2), ([4, 5, 7], 7)])
def test_every_process_probes_and_fits_on_its_own_gpu(
    monkeypatch, launcher, devices, expected
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name in ("LOCAL_RANK", "SLURM_LOCALID"):
        monkeypatch.delenv(name, raising=False)
    factory = TrainerFactory(
        make=Trainer, accelerator="auto", devices=devices, precision="32-true"
    )
    first = 0 if devices == "auto" else devices[0]
    assert factory.device == torch.device("cuda", first)
    monkeypatch.setenv(launcher, "2")
    assert factory.device == torch.device("cuda", expected)
    on_cpu = replace(factory, accelerator="cpu")
    assert on_cpu.device == torch.device("cpu")
