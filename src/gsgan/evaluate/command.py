"""What ``gsgan.evaluate`` does: scores a run folder, or a folder of any method's images."""

from __future__ import annotations

import json
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import track

from gsgan.evaluate.facts import Method
from gsgan.evaluate.files import FACTS_FILE, METRICS_FILE
from gsgan.evaluate.predictions import Pattern, read_folder, some
from gsgan.evaluate.run import (
    Selection,
    check_background,
    evaluate_method,
    evaluate_run,
    make_scorer,
)
from gsgan.evaluate.split import FLOOR, FULL
from gsgan.evaluate.tables import Results
from gsgan.train.runs import (
    CHECKPOINT,
    Moved,
    build_data,
    load_avatar,
    load_config,
    read_checkpoint,
)
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import ConfigError


def evaluate_config(config: DictConfig) -> Results:
    """Scores ``config.run`` or ``config.predictions``.

    Raises:
        ConfigError: unless exactly one of them is given.
        GsganError: see `evaluate_folder` and `evaluate_predictions`.
    """
    if config.run is not None and config.predictions is not None:
        raise ConfigError("run and predictions are both set; give one of them")
    if config.run is None and config.predictions is None:
        raise ConfigError(
            "run is not set: give run=<the folder that gsgan.train printed>, or "
            "predictions=<folder of images> with data= and data.root="
        )
    return evaluate_folder(config) if config.run is not None else evaluate_predictions(config)


def evaluate_folder(config: DictConfig) -> Results:
    """Loads the avatar of ``config.run`` and scores it.

    Raises:
        ConfigError: on a key that does not apply to a run.
        DataError: when the folder, its checkpoint or its data cannot be used.
    """
    for key, instead in (
        ("data", "data_root= and data_smpl= where it has moved"),
        ("protocol", "the run's is used"),
        ("out", "its scores go into the run folder"),
        ("method", "it is gsgan"),
    ):
        if config.get(key) is not None:
            raise ConfigError(f"{key}= cannot be given with run= ({instead}); leave it out")
    selection = Selection(config.splits, config.per, config.pictures)
    check_background("background", config.background)
    device, console = pick_device(config.device), make_console()
    folder = Path(config.run).expanduser()
    stored = load_config(folder, Moved.from_config(config))
    data = build_data(stored)
    avatar, marks = load_avatar(folder, stored, data)
    state = read_checkpoint(folder / CHECKPOINT)["gsgan"]
    default = "black" if data.protocol is None else data.protocol.measures.background
    out = None
    if config.background not in (None, default):  # the scores on the run's background stay
        out = folder / f"on_{config.background}"
        console.print(f"scores on {config.background} go into {out}", soft_wrap=True)
    method = Method(
        "gsgan",
        seed=stored.seed,
        iterations=state["step"],
        train_seconds=state.get("train_seconds"),
        trained_by=tuple(state["code"]) if "code" in state else None,
    )
    return evaluate_run(
        folder,
        config,
        console,
        out=out,
        data=data,
        avatar=avatar.to(device),
        marks=marks,
        method=method,
        selection=selection,
    )


def evaluate_predictions(config: DictConfig) -> Results:
    """Scores the folder ``config.predictions`` on the config's data.

    Raises:
        ConfigError: on a value that cannot be used.
        DataError: when the folder or an image in it cannot be used.
    """
    if config.get("data") is None:
        raise ConfigError(
            "data is not set: give the data of the predictions, as for training, e.g. "
            "data=zju_mocap data.root=… protocol=zju_gauhuman"
        )
    for key in ("root", "smpl"):
        if config[f"data_{key}"] is not None:
            raise ConfigError(f"data_{key} is for run=; give data.{key} with predictions=")
    check_background("predictions_background", config.predictions_background)
    selection = Selection(config.splits, config.per, config.pictures)
    pattern = Pattern(config.predictions_pattern)
    root = Path(config.predictions).expanduser()
    name = config.method or root.resolve().name
    device, console = pick_device(config.device), make_console()
    data = build_data(config)
    default = "black" if data.protocol is None else data.protocol.measures.background
    background = config.predictions_background or default
    expected = {split: data.dataset(split).items for split in selection.splits}
    folder = read_folder(root, pattern, expected, data.layout.camera_names, background)
    out = _out(config, root, name)
    if folder.extra:
        text = f"{len(folder.extra)} files of {root} are not scored: {some(folder.extra)}"
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    for split in selection.splits:
        dataset = data.dataset(split)
        for item in track(dataset.items, f"checking {split}", console=console, transient=True):
            folder.check(item, dataset.camera(item).size)
    results = evaluate_method(
        out,
        console,
        data,
        folder.predict,
        make_scorer(config, data, []),
        method=Method(name, data=_data_choice()),
        device=device,
        variants=(FULL, FLOOR),
        selection=selection,
        no_parts="predictions are pictures, not a segmentation",
    )
    console.print(f"scores: {out}", markup=False, highlight=False, soft_wrap=True)
    return results


def _out(config: DictConfig, root: Path, method: str) -> Path:
    """The folder for scores: not inside the predictions, no run, no other method's scores."""
    whole = root.resolve()
    out = whole.with_name(f"{whole.name}_scores")
    if config.out is not None:
        out = Path(config.out).expanduser()
    if out.resolve() == whole or whole in out.resolve().parents:
        raise ConfigError(f"out={out} is inside the predictions; choose another folder")
    if out.exists() and not out.is_dir():
        raise ConfigError(f"out={out} is a file; choose a folder")
    if (out / ".hydra").exists() or (out / CHECKPOINT).exists():
        raise ConfigError(f"out={out} is a run folder; choose another one")
    if (out / METRICS_FILE).is_file():
        try:
            found = json.loads((out / FACTS_FILE).read_text())["method"]
        except (OSError, ValueError, KeyError, TypeError):
            found = None
        if found != method:
            raise ConfigError(
                f"out={out} holds scores of {found or 'something else'}, not of {method}; choose "
                "another folder"
            )
    return out


def _data_choice() -> str | None:
    if not HydraConfig.initialized():
        return None
    choice = HydraConfig.get().runtime.choices.get("data")
    return None if choice is None else str(choice)
