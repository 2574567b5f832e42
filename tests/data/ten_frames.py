"""The capture that the tests of splits, loaders and config files share."""

import pytest
from make import write_tiny_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Three cameras, ten frames, labels and poses."""
    root = tmp_path_factory.mktemp("data") / "capture"
    return write_tiny_capture(root, cameras=3, frames=10, labels=True, body_pose=True)
