#!/usr/bin/env bash
# Builds the wheel, installs it in an empty environment and trains from another directory.
set -euo pipefail
cd "$(dirname "$0")/.."
repo=$PWD
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
make wheel
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check \
  -c "$repo/constraints.txt" "$(ls -t "$repo"/dist/gsgan-*.whl | head -1)"
cd "$work"
export GSGAN_CACHE="$work/cache" # no caches of the checkout
inside=$(venv/bin/python -m zipfile -l "$(ls -t "$repo"/dist/gsgan-*.whl | head -1)")
for file in gsgan/conf/train.yaml gsgan/body/assets/free_body.npz gsgan/body/assets/body_space.npz gsgan/body/assets/ATTRIBUTION.md \
  gsgan/synthetic/avatars/{blouse,polo}.glb gsgan/synthetic/avatars/{LICENSE,ATTRIBUTION.md} \
  gsgan/splat/native.cpp gsgan/splat/kernels/tile.h gsgan/skeleton/templates.npz; do
  [[ $inside == *"$file"* ]] || { echo "the wheel lacks $file"; exit 1; }
done
"$work/venv/bin/python" -c '
import shutil
from gsgan.splat import build, native
if any(map(shutil.which, build.COMPILERS)):
    assert native.available(), native.why_not()
'
"$work/venv/bin/python" -m gsgan.train experiment=demo training=smoke \
  size=small data.source.frames=12 data.source.test_frames=4 \
  hydra.run.dir="$work/run"
test -s "$work/run/metrics.json"
"$work/venv/bin/python" -m gsgan.evaluate run="$work/run"
"$work/venv/bin/python" -m gsgan.report run="$work/run" runs="$work/run" figures=[strip]
"$work/venv/bin/python" -m gsgan
for command in prepare check fit; do
  "$work/venv/bin/python" -m gsgan.$command --help >help.txt
done
"$work/venv/bin/python" -m gsgan.bench speed --help >help.txt
echo "the wheel works from $work"
