"""What ``gsgan.evaluate`` does: a run folder, or a folder of any method's pictures."""

from __future__ import annotations

import json
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import track

from gsgan.data.datamodule import GsganData
from gsgan.evaluate.facts import Method
from gsgan.evaluate.files import FACTS_FILE, METRICS_FILE
from gsgan.evaluate.folder import SHOWN, Folder, Pattern, check_headers, read_folder
from gsgan.evaluate.run import Wanted, check_background, evaluate_method, evaluate_run, make_scorer
from gsgan.evaluate.shuffled import Exchanged
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
    """Scores what the config names.

    Raises:
        ConfigError: when it names neither a run nor predictions, or both.
        GsganError: see `evaluate_folder` and `evaluate_predictions`.
    """
    if (config.run is None) == (config.predictions is None):
        if config.run is not None:
            raise ConfigError("run and predictions are both set; give one of them")
        raise ConfigError(
            "run is not set: give run=<the folder that gsgan.train printed>, or "
            "predictions=<folder of pictures> with data= and data.root="
        )
    return evaluate_folder(config) if config.run is not None else evaluate_predictions(config)


def evaluate_folder(config: DictConfig) -> Results:
    """Rebuilds the avatar of ``config.run`` and scores it.

    Raises:
        ConfigError: on a key that a run does not take.
        DataError: when the folder, its checkpoint or its data is not what it should be.
    """
    for key, instead in (
        ("data", "data_root= and data_smpl= where it has moved"),
        ("protocol", "the run's own is used"),
        ("out", "its scores go into the run folder"),
        ("method", "it is gsgan"),
    ):
        if config.get(key) is not None:
            raise ConfigError(f"a run has its own {key}: leave {key}= out beside run= ({instead})")
    wanted = Wanted(config.splits, config.per, config.pictures)
    device = pick_device(config.device)
    folder = Path(config.run).expanduser()
    stored = load_config(folder, Moved.said(config))
    data = build_data(stored)
    avatar, marks = load_avatar(folder, stored, data)
    state = read_checkpoint(folder / CHECKPOINT)["gsgan"]
    check_background(config.background)
    usual = "black" if data.protocol is None else data.protocol.measures.background
    elsewhere = config.background not in (None, usual)  # a run's own scores stay
    out = folder / f"on_{config.background}" if elsewhere else None
    console = make_console()
    if out is not None:
        console.print(f"scores on {config.background} go into {out}", soft_wrap=True)
    return evaluate_run(
        folder,
        config,
        console,
        out=out,
        data=data,
        avatar=avatar.to(device),
        marks=marks,
        method=Method(
            "gsgan",
            seed=stored.seed,
            iterations=state["step"],
            train_seconds=state.get("train_seconds"),
            trained_by=tuple(state["code"]) if "code" in state else None,
        ),
        wanted=wanted,
    )


def evaluate_predictions(config: DictConfig) -> Results:
    """Scores the folder ``config.predictions`` on the config's data.

    Raises:
        ConfigError: on a value that does not fit.
        DataError: when the folder or a picture in it is not what it should be.
    """
    if config.get("data") is None:
        raise ConfigError(
            "data is not set: give the data that the predictions are of, as for training, e.g. "
            "data=zju_mocap data.root=… protocol=zju_gauhuman"
        )
    for key in ("root", "smpl"):
        if config[f"data_{key}"] is not None:
            raise ConfigError(f"data_{key} is for run=; give data.{key} beside predictions=")
    wanted = Wanted(config.splits, config.per, config.pictures)
    pattern = Pattern(config.predictions_pattern)
    root = Path(config.predictions).expanduser()
    name = config.method or root.resolve().name
    watch = None if config.predictions_margin is None else Exchanged(config.predictions_margin)
    device, console = pick_device(config.device), make_console()
    data = build_data(config)
    background = _background(config, data)
    expected = {split: data.dataset(split).items for split in wanted.splits}
    folder = read_folder(root, pattern, expected, data.layout.camera_names, background)
    out = _out(config, root, name)
    if folder.extra:
        shown = ", ".join(folder.extra[:SHOWN]) + (" …" if len(folder.extra) > SHOWN else "")
        told = f"{len(folder.extra)} files of {root} are not asked for and not scored: {shown}"
        console.print(told, markup=False, highlight=False, soft_wrap=True)
    for split in wanted.splits:
        dataset = data.dataset(split)
        told = f"looking at {split}"
        for item in track(dataset.items, told, console=console, transient=True):
            check_headers(folder, item, dataset.camera(item).size)
    results = evaluate_method(
        out, console, data, folder.predict, make_scorer(config, data, []), config.lpips.net,
        method=Method(name, data=_data_choice()),
        device=device,
        variants=(FULL, FLOOR),
        wanted=wanted,
        no_parts="predictions are pictures, not a segmentation",
        watch=None if watch is None else watch.see,
        check=None if watch is None else lambda: watch.check(_paths(folder)),
    )  # fmt: skip
    console.print(f"scores: {out}", markup=False, highlight=False, soft_wrap=True)
    return results


def _paths(folder: Folder) -> dict[tuple[str, int], str]:
    return {item: str(folder.root / name) for item, name in folder.files.items()}


def _background(config: DictConfig, data: GsganData) -> str:
    """What opaque predictions are painted on: as said, else the protocol's, else black."""
    given = config.predictions_background
    if given not in (None, "black", "white"):
        raise ConfigError(f"predictions_background must be black, white or null; got {given!r}")
    protocols = "black" if data.protocol is None else data.protocol.measures.background
    return str(given or protocols)


def _out(config: DictConfig, root: Path, method: str) -> Path:
    """Where scores go: never among the predictions, a run's files, or another method's scores."""
    whole = root.resolve()
    out = whole.with_name(f"{whole.name}_scores")
    if config.out is not None:
        out = Path(config.out).expanduser()
    if out.resolve() == whole or whole in out.resolve().parents:
        raise ConfigError(f"out={out} lies inside the predictions; choose a folder beside them")
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
