#!/usr/bin/env bash
# Builds the wheel, installs it in an empty environment and trains from another directory. Of .venv, the environment
# sees only the packages that the wheel depends on, as links: extras and tools must not be needed.
set -euo pipefail
cd "$(dirname "$0")/.."
repo=$PWD
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
make wheel
wheel=$(ls -t dist/gsgan-*.whl | head -1)
python=$folder/venv/bin/python
.venv/bin/python -m venv --without-pip "$folder/venv"
.venv/bin/pip --python "$python" install --quiet --no-deps --no-index "$wheel"
.venv/bin/python - "$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')" <<'END'
import sys
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement

site = Path(sys.argv[1])
missing, linked = {"gsgan"}, set()
while missing:
    name = missing.pop()
    linked.add(name)
    for requirement in map(Requirement, distribution(name).requires or ()):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            missing |= {requirement.name} - linked
    if name != "gsgan":
        for entry in {path.parts[0] for path in distribution(name).files} - {"..", "__pycache__"}:
            if not (site / entry).exists():
                (site / entry).symlink_to(distribution(name).locate_file(entry))
END
cd "$folder"
export GSGAN_CACHE="$folder/cache" # no caches of the checkout
unset PYTHONPATH
"$python" - <<'END'
import shutil
from importlib.util import find_spec
from pathlib import Path

import gsgan
from gsgan.splat import build, native

package = Path(gsgan.__file__).parent
assert package.is_relative_to(Path.cwd()), package
assert find_spec("pytest") is None and find_spec("viser") is None, "the environment is not empty"
for file in (
    "conf/train.yaml",
    *("body/assets/free_body.npz", "body/assets/body_space.npz", "body/assets/ATTRIBUTION.md"),
    *(f"synthetic/avatars/{name}" for name in ("blouse.glb", "polo.glb", "LICENSE", "ATTRIBUTION.md")),
    *(f"export/web/{name}" for name in ("gsgan.js", "page.html", "page.css")),
    *(f"run/demo/{name}" for name in ("config.json", "model.safetensors", "README.md", "dance.npz")),
  *("splat/native.cpp", "splat/kernels/tile.h", "skeleton/templates.npz"),
):
    assert (package / file).is_file(), f"the wheel lacks {file}"
if any(map(shutil.which, build.COMPILERS)):
    assert native.available(), native.why_not()
END
"$python" -m gsgan.train experiment=smoke \
  data.source.frames=6 data.source.test_frames=2 data.source.rays_per_pixel=4 \
  evaluate=false hydra.run.dir="$folder/run"
"$python" -m gsgan.evaluate run="$folder/run"
test -s run/metrics.json
"$python" -m gsgan.report run="$folder/run" runs="$folder/run" figures=[strip]
"$folder/venv/bin/gsgan"
"$folder/venv/bin/gsgan" demo out="$folder/demo" frames=5 pixels=128
test -s demo/picture.png
for command in prepare check fit; do
  "$python" -m gsgan.$command --help >help.txt
done
"$python" -m gsgan.bench speed --help >help.txt
echo "the wheel works from $folder"
