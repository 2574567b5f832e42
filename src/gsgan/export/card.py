"""The model card of an exported avatar: data, training, effects, scores, use and licence."""

import json
from pathlib import Path
from typing import Any

import yaml

from gsgan import __version__
from gsgan.metrics.names import FLOOR_VARIANT, FULL, VARIANTS
from gsgan.run.runs import Run, marks_of
from gsgan.utils.pages import markdown

LINEAR = (
    "without its networks: Step I's colour, with residuals linear in the harmonics of each "
    "Gaussian's normal."
)
# What a model card says about the content of each format.
HOLDS = {
    "ply": "The avatar's Gaussians in one pose per file, in the convention of 3D Gaussian "
    "splatting. They show Step I's colour; the generator's image needs gsgan.",
    "splat": "The avatar's Gaussians in one pose, in 32 bytes each, with Step I's colours from all "
    "directions; the generator's image needs gsgan.",
    "spz": "The avatar's Gaussians in one pose, compressed. They show Step I's colour; the "
    "generator's image needs gsgan.",
    "gltf": "The avatar's Gaussians in one pose, as KHR_gaussian_splatting. They show Step I's "
    "colour; the generator's image needs gsgan.",
    "usd": "The avatar's Gaussians in one pose, or in the poses of a motion, as OpenUSD's "
    "ParticleField3DGaussianSplat. They show Step I's colour; the generator's image needs gsgan.",
    "onnx": "Pose encoder and generator: images of the splats and the skeleton in, image and alpha "
    "out. Rasterisation is not part of it.",
    "torch": "The whole avatar as a program of `torch.export`: skeleton and camera in, image and "
    "alpha out. Import `gsgan.splat` before loading it.",
    "html": f"A page that renders the avatar in a browser, {LINEAR}",
    "bin": f"The avatar of a web page, for gsgan.js in a page of your own, {LINEAR}",
    "safetensors": "The weights, with the config as metadata: "
    "`gsgan.export.weights.load_weights(file)` gives the avatar.",
    "hub": "Weights and config, without the dataset.",
}
# The persons that come with gsgan, and the licence of weights that show them.
FREE_PERSONS = ("polo", "blouse", "free_body")
FREE_LICENCE = "mit"
# Metrics of a model card, and their headings.
SCORES = {
    "psnr": "PSNR ↑",
    "ssim": "SSIM ↑",
    "lpips_vgg": "LPIPS-VGG ↓",
    "lpips_alex": "LPIPS-Alex ↓",
    "edge_f1": "edge F1 ↑",
}
HUB_USE = """\
![A rendered pose](preview.png)

```python
import gsgan

avatar = gsgan.load("{name}")
```"""
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
    free = run.trained_as.character in FREE_PERSONS

    # The card's header is read by hubs such as Hugging Face.
    head: dict[str, Any] = {
        "license": licence or (FREE_LICENCE if free else "other"),
        "library_name": "gsgan",
        "tags": ["gaussian-splatting", "human-avatar", "synthetic-media"],
    }
    results = _results(run.folder, str(data.get("name")))
    if results:
        head["model-index"] = [{"name": name, "results": results}]

    # How the avatar was trained; unknown facts are left out.
    identity = [data.get(key) for key in ("name", "root", "fingerprint")]
    about = {
        "data": " ".join(str(value) for value in identity if value),
        "training cameras": run.scene.n_train_cameras,
        "image size": run.trained_as.image_size,
        "protocol": facts.get("protocol") or "none",
        "model": facts.get("model"),
        "iterations": run.checkpoint["step"],
        "seed": run.trained_as.seed,
        "gsgan": facts.get("version", __version__),
        "commit": facts.get("commit"),
    }
    rows = []
    for key, value in about.items():
        if value not in (None, ""):
            rows.append((key, str(value)))

    # Scores, and what makes them incomparable with others.
    scores = [_scores(run.folder)]
    scores += [f"- marked: {mark}" for mark in marks_of(run.checkpoint)]
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---",
        f"# {name}\n\nOne person's avatar, trained with gsgan (GaussianGAN). {HOLDS[kind]}",
        *([HUB_USE.format(name=name)] if kind == "hub" else []),
        f"## Data and training\n\n{markdown(('', ''), rows)}",
        f"## Effects\n\n{markdown(('effect', '', 'why'), run.avatar.effects.rows())}",
        "## Scores on held-out images\n\n" + "\n\n".join(scores),
        f"## Intended use\n\n{USE}",
        "## Licence\n\n" + (licence or _licence(free)),
    ]
    return "\n\n".join(parts) + "\n"


def _licence(free: bool) -> str:
    if free:
        owner = (
            "The default person is a character under the MIT licence; weights trained on it are "
            "too."
        )
    else:
        owner = (
            "The weights show a person: that person and the owner of the training images decide "
            "what may be done with them. State it with licence=."
        )
    return f"gsgan itself is under Apache-2.0. {owner}"


def _scores(folder: Path) -> str:
    # One row per split and variant that a user of the file can render.
    table = []
    for split, variants in _read(folder / "metrics.json").items():
        for variant, scores in variants.items():
            if variant != FLOOR_VARIANT:
                numbers = [_number(scores.get(key)) for key in SCORES]
                table.append((split, VARIANTS[variant], *numbers))

    if not table:
        return "Not evaluated: run `python -m gsgan.evaluate` first."
    return markdown(("split", "", *SCORES.values()), table)


def _results(folder: Path, data: str) -> list[dict[str, Any]]:
    """The scores of the final image as the header of a card states them, one result per split."""
    results = []
    for split, variants in _read(folder / "metrics.json").items():
        # Metrics that were not computed are left out.
        metrics = []
        for key, heading in SCORES.items():
            value = variants.get(FULL, {}).get(key)
            if value is not None:
                heading = heading.rstrip(" ↑↓")
                metrics.append({"type": key, "name": heading, "value": value})
        if metrics:
            result = {
                "task": {"type": "image-to-image", "name": split},
                "dataset": {"type": data, "name": data},
                "metrics": metrics,
            }
            results.append(result)
    return results


def _number(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.4g}"


def _read(path: Path) -> dict[str, Any]:
    # A run that has not been evaluated lacks these files.
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
