"""What data and machine decide by themselves, and the factors that belong to a study."""

import pytest
from hydra import compose, initialize_config_dir

from gsgan.utils.config import config_folder, if_gpu

DATA = sorted(
    path.stem for path in (config_folder() / "data").glob("[!_]*.yaml")
)


# The groups that the data chooses, with nothing else on the command line.
CHOICES = {
    "avatarrex": ("full", "long"),
    "capture": if_gpu(("own", "long"), ("cpu_512", "cpu_512")),
    "easymocap": ("small", "demo"),
    "synthetic": ("cpu_512", "cpu_512"),
    "thuman4": ("full", "long"),
    "zju_mocap": ("full", "long"),
}


def choices(*overrides):
    """The choices of the groups size and training, and the data's name."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("train", list(overrides), return_hydra_config=True)
    found = config.hydra.runtime.choices
    return found.size, found.training, found.data


@pytest.mark.parametrize("data", DATA)
def test_the_data_chooses_size_and_training(data):
    assert choices(f"data={data}") == (*CHOICES[data], data)
    by_name = choices(f"data={data}", "size=small", "training=demo")
    assert by_name == ("small", "demo", data)


def test_the_command_line_comes_before_the_experiment_and_that_before_the_data():
    assert choices("experiment=smoke") == ("tiny", "smoke", "synthetic")
    large = ("experiment=smoke", "data=thuman4")
    assert choices(*large) == ("tiny", "smoke", "thuman4")
    assert choices(*large, "size=mid") == ("mid", "smoke", "thuman4")
    assert choices("data=thuman4", "training=demo") == (
        "full",
        "demo",
        "thuman4",
    )


@pytest.mark.parametrize(
    ("there", "told"),
    [(True, ("gpu", "bf16-mixed")), (False, ("cpu", "32-true"))],
)
def test_the_accelerator_is_the_one_that_is_there(
    compose, monkeypatch, there, told
):
    monkeypatch.setattr("torch.cuda.is_available", lambda: there)
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda *_: (8, 6))
    trainer = compose("train").trainer
    assert (trainer.accelerator, trainer.precision) == told
    assert compose("train", "trainer=cpu").trainer.accelerator == "cpu"


@pytest.mark.slow
def test_a_long_run_without_a_gpu_is_refused_with_its_price_until_it_is_asked_for(
    inside, capture, tmp_path
):
    """Tiny, with a budget to match."""
    few = [
        "data=capture",
        f"data.root={capture}",
        "size=tiny",
        "training=smoke",
        "data.crop=null",
        "evaluate=false",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    refused = inside("train", *few, "cpu_hours=1e-9")
    assert refused.returncode == 1
    assert "no GPU is found, and on this CPU 16 iterations" in refused.stderr
    assert "size=small training=demo" in refused.stderr
    assert refused.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()
    assert (
        inside("train", *few, "cpu_hours=1e-9", "trainer=cpu").returncode == 0
    )


# --- factors that make baselines train equally long


@pytest.mark.parametrize(
    "model", ["splat_only", "harmonic", "lbs_splat", "image_to_image"]
)
def test_a_baseline_is_stretched_by_an_experiment_only(compose, model):
    assert (
        compose(
            "train", f"model={model}", "training=paper"
        ).training.schedule.stretch
        == 1
    )
    study = compose("train", "experiment=study", f"model={model}")
    assert study.training.schedule.stretch == study.equal_time[model] > 1
    assert compose("train", "experiment=study").training.schedule.stretch == 1
