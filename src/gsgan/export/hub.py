"""An avatar as a folder in the form of the Hugging Face Hub, and its upload."""

import json
from collections.abc import Mapping
from typing import Any

import torch
from PIL import Image

from gsgan import __version__
from gsgan.export.weights import facts_of, weights_bytes
from gsgan.motion.orbit import Orbit
from gsgan.run.drive import Drive, inputs_of
from gsgan.run.runs import Run
from gsgan.run.shared import CONFIG_FILE, NEEDS_HUB, WEIGHTS_FILE, first_line
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.provenance import png_bytes

PREVIEW = "preview.png"
CARD_FILE = "README.md"
WHITE = 1.0


def avatar_files(run: Run) -> dict[str, bytes]:
    """The files that `gsgan.load` reads, by name.

    Raises:
        DataError: when the config names a class that is not one of gsgan's own configs.
    """
    facts: dict[str, Any] = facts_of(run)
    # The body model file lies on this machine.
    facts["gsgan"]["scene"] |= {"body_file": None}
    config = {"library_name": "gsgan", "version": __version__} | facts
    return {
        CONFIG_FILE: (json.dumps(config, indent=1) + "\n").encode(),
        WEIGHTS_FILE: weights_bytes(run.avatar, {}),
    }


@torch.no_grad()
def preview(run: Run, drive: Drive, size: int) -> bytes:
    """A PNG file of a motion's first pose from the front, on white, marked as synthetic.

    Args:
        run: the avatar's.
        drive: the motion.
        size: pixels of the square image.
    """
    trained = run.trained_as.image_size or size
    camera = Orbit().cameras(
        drive.p[:1], run.proportions, run.scene, size=size, trained=trained
    )
    p, visibility, body = inputs_of(run.avatar, drive, 0)
    image = run.avatar.render(
        p, camera, visibility=visibility, body=body, background=WHITE
    )
    pixels = (255 * image[0]).round().byte().permute(1, 2, 0)
    return png_bytes(Image.fromarray(pixels.cpu().numpy()))


def refuse_missing_hub(repository: str) -> None:
    """Raises a ConfigError if the package huggingface_hub is missing, or the name is not one that
    the Hub takes."""
    try:
        from huggingface_hub.errors import HFValidationError
        from huggingface_hub.utils import validate_repo_id
    except ImportError:
        raise ConfigError(f"upload: {NEEDS_HUB}") from None
    try:
        validate_repo_id(repository)
    except HFValidationError as error:
        raise ConfigError(f"upload={repository}: {first_line(error)}") from None


def upload(files: Mapping[str, bytes], repository: str, private: bool) -> str:
    """Uploads files in one commit, to a repository that is made if it does not exist.

    Args:
        files: content by name.
        repository: ``owner/name``.
        private: whether a new repository is private.

    Returns:
        The address of the commit.

    Raises:
        DataError: when the user is not logged in, may not write there, or the Hub cannot be
            reached.
    """
    from huggingface_hub import CommitOperationAdd, HfApi, constants
    from huggingface_hub.errors import HTTPError

    api = HfApi(library_name="gsgan", library_version=__version__)
    operations = [
        CommitOperationAdd(path_in_repo=name, path_or_fileobj=content)
        for name, content in files.items()
    ]
    # Errors of the network are HTTPError, all others are kinds of OSError or ValueError.
    try:
        api.create_repo(repository, private=private, exist_ok=True)
        commit = api.create_commit(
            repository, operations, commit_message="Written by gsgan.export"
        )
    except (HTTPError, OSError, ValueError) as error:
        raise DataError(
            f"upload={repository}: not accepted by {constants.ENDPOINT} ({first_line(error)}); "
            "log in by `hf auth login`, or set HF_TOKEN to a token that may write"
        ) from None
    return commit.commit_url
