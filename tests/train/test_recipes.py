"""The recipes of docs/reliability.md for several machines: what torchrun and SLURM set up."""

import re
import shlex

import pytest
from commands import ROOT
from hydra.utils import instantiate

PAGE = (ROOT / "docs" / "reliability.md").read_text()
ON_CPU = ("trainer.accelerator=cpu", "trainer.precision=32-true")
TORCHRUN = "RANK=5 LOCAL_RANK=1 GROUP_RANK=1 WORLD_SIZE=8 MASTER_PORT=29500 TORCHELASTIC_RUN_ID=1"
SRUN = (
    "SLURM_NTASKS=8 SLURM_NTASKS_PER_NODE=4 SLURM_PROCID=5 SLURM_LOCALID=1 SLURM_NODEID=1 "
    "SLURM_JOB_ID=7 SLURM_JOB_NAME=gsgan SLURM_NODELIST=node[0-1] SLURM_JOB_NUM_NODES=2"
)
STARTERS = {"torchrun": f"{TORCHRUN} MASTER_ADDR=127.0.0.1", "srun": SRUN}


def recipe(starter: str) -> list[str]:
    """The words of a command of the page, its continued lines joined."""
    blocks = "\n".join(re.findall(r"```bash\n(.*?)```", PAGE, flags=re.DOTALL))
    lines = blocks.replace("\\\n", " ").splitlines()
    (line,) = (line for line in lines if line.startswith(starter))
    return shlex.split(line)


@pytest.mark.parametrize("starter", STARTERS)
def test_a_recipe_makes_one_training_of_all_its_processes(
    starter, compose, monkeypatch
):
    words = recipe(starter)
    arguments = words[words.index("gsgan.train") + 1 :]
    # else one by process
    assert any(word.startswith("hydra.run.dir=") for word in arguments)
    for variable in STARTERS[starter].split():
        monkeypatch.setenv(*variable.split("="))
    given = [a for a in arguments if not a.startswith("hydra.")]
    trainer = instantiate(
        compose("train", *given, *ON_CPU).trainer, logger=False
    )
    assert (trainer.world_size, trainer.num_nodes, trainer.num_devices) == (
        8,
        2,
        4,
    )
    environment = trainer.strategy.cluster_environment
    assert environment.creates_processes_externally
    ranks = (
        environment.global_rank(),
        environment.local_rank(),
        environment.node_rank(),
    )
    assert ranks == (5, 1, 1)
