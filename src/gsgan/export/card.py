"""The model card written beside an exported file."""

import json
from pathlib import Path
from typing import Any

import yaml

from gsgan import __version__
from gsgan.effects.table import rows
from gsgan.model.runs import Run
from gsgan.utils.pages import markdown

LINEAR = (
    "without its networks: Step I's colour, with residuals linear in the harmonics of each "
    "Gaussian's normal."
)
HOLDS = {
    "ply": "The avatar's Gaussians in one pose per file, in the convention of 3D Gaussian "
    "splatting. They show Step I's colour; the generator's image needs gsgan.",
    "gltf": "The avatar's Gaussians in one pose, as KHR_gaussian_splatting. They show Step I's "
    "colour; the generator's image needs gsgan.",
    "onnx": "Pose encoder and generator: images of the splats and the skeleton in, image and alpha "
    "out. Rasterisation is not part of it.",
    "torch": "The whole avatar as a program of `torch.export`: skeleton and camera in, image and "
    "alpha out. Import `gsgan.splat` before loading it.",
    "html": f"A page that renders the avatar in a browser, {LINEAR}",
    "bin": f"The avatar of a web page, for gsgan.js in a page of your own, {LINEAR}",
    "safetensors": "The weights, with the config as metadata: "
    "`gsgan.export.weights.load_weights(file)` gives the avatar.",
}
SCORES = {"psnr": "PSNR ↑", "ssim": "SSIM ↑", "lpips": "LPIPS ↓", "edge_f1": "edge F1 ↑"}
VARIANTS = {"full": "final image", "splat": "Step I's colour"}
USE = """\
Images of this one person in new poses and from new cameras, with the person's consent: sign
language, research, telepresence, film. Its images are synthetic: say so where they are shown
(`gsgan.render` writes it into the files' metadata).

Not intended for deceiving anyone about what the person did or said, or for identifying people.
Poses and cameras far from the training data give worse images than the scores suggest."""


def card(run: Run, kind: str, name: str, licence: str | None) -> str:
    """The text of a model card.

    Args:
        run: the avatar's.
        kind: a key of `HOLDS`.
        name: of the exported file or folder.
        licence: of the weights, or None if the user gave none.
    """
    facts = _read(run.folder / "facts.json")
    data = facts.get("data", {})
    scene = run.scene
    head = {"license": licence or "other", "library_name": "gsgan"}
    head["tags"] = ["gaussian-splatting", "human-avatar", "synthetic-media"]  # type: ignore[assignment]
    about = {
        "data": " ".join(str(data[k]) for k in ("name", "root", "fingerprint") if data.get(k)),
        "training cameras": scene.n_train_cameras,
        "image size": run.stored.data.size,
        "protocol": facts.get("protocol") or "none",
        "model": facts.get("model"),
        "iterations": run.checkpoint["step"],
        "seed": run.stored.get("seed"),
        "gsgan": facts.get("version", __version__),
        "commit": facts.get("commit"),
    }
    known = [(key, str(value)) for key, value in about.items() if value not in (None, "")]
    marks = [f"- marked: {mark}" for mark in run.checkpoint.get("marks", [])]
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---",
        f"# {name}\n\nOne person's avatar, trained with gsgan (GaussianGAN). {HOLDS[kind]}",
        f"## Data and training\n\n{markdown(('', ''), known)}",
        f"## Effects\n\n{markdown(('effect', '', 'why'), rows(run.avatar.effects))}",
        "## Scores on held-out images\n\n" + "\n\n".join([_scores(run.folder), *marks]),
        f"## Intended use\n\n{USE}",
        "## Licence\n\n" + (licence or _licence(data.get("name"))),
    ]
    return "\n\n".join(parts) + "\n"


def _licence(data: str | None) -> str:
    owner = (
        "The default person is a character under the MIT licence; weights trained on it are too."
        if data == "synthetic"
        else "The weights show a person: that person and the owner of the training images decide "
        "what may be done with them. State it with licence=."
    )
    return f"gsgan itself is under Apache-2.0. {owner}"


def _scores(folder: Path) -> str:
    table = [
        (split, VARIANTS[variant], *(_number(scores.get(key)) for key in SCORES))
        for split, variants in _read(folder / "metrics.json").items()
        for variant, scores in variants.items()
        if variant in VARIANTS
    ]
    if not table:
        return "Not evaluated: run `python -m gsgan.evaluate` first."
    return markdown(("split", "", *SCORES.values()), table)


def _number(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.4g}"


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):  # the run has not been evaluated
        return {}
    return found if isinstance(found, dict) else {}
