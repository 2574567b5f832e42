"""Adds compiled kernels to a wheel where ``GSGAN_WHEEL_KERNELS=1`` asks for it.

Other wheels are pure Python, and compile the kernels on first use.
"""

import os
import platform
import runpy
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

KERNELS = "src/gsgan/splat"


class KernelHook(BuildHookInterface):
    """Compiles the kernels for any processor of the platform, and names the wheel after it."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compiles; raises CalledProcessError where it fails."""
        if os.environ.get("GSGAN_WHEEL_KERNELS") != "1":
            return
        folder = Path(self.root) / KERNELS
        flags = runpy.run_path(str(folder / "flags.py"))

        # The library is written beside other build output.
        library = Path(self.root) / "build" / "prebuilt.so"
        library.parent.mkdir(exist_ok=True)
        subprocess.run(
            [
                os.environ.get("CXX", "g++"),
                *flags["BASE_FLAGS"],
                *flags["WHEEL_FLAGS"][platform.machine()],
                str(folder / "native.cpp"),
                "-o",
                str(library),
            ],
            check=True,
        )
        build_data["force_include"][str(library)] = "gsgan/splat/prebuilt.so"

        # It serves every version of Python, since ctypes loads it.
        tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{tag}"
