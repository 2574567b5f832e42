#!/usr/bin/env bash
# Every check that needs CUDA, in at most 20 minutes, and docs/results/gpu.md from what it printed.
# A step that is done is not repeated: run it again after an interruption, or after
# removing outputs/gpu_check/<step>.done.  PYTHON, OUT and PAGE replace the defaults below.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python} out=${OUT:-outputs/gpu_check} page=${PAGE:-docs/results/gpu.md}
limit=1200 # seconds of all steps together
if ! "$python" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'; then
  echo "gpu_check: torch finds no CUDA device on this machine, so nothing was checked."
  exit 1
fi
mkdir -p "$out"
began=$SECONDS failed=0 steps=()

# step NAME SECONDS COMMAND...: runs it once, for at most so long; its output goes to NAME.log
step() {
  local name=$1 most=$2 left=$((limit - SECONDS + began)) start=$SECONDS
  shift 2
  steps+=("$name")
  [[ -e $out/$name.done ]] && return
  if ((left <= 0)); then
    echo "not run: the time is up" >"$out/$name.failed"
    failed=1
    return
  fi
  echo "$name: $*"
  printf '%q ' "$@" >"$out/$name.command"
  if timeout $((most < left ? most : left)) "$@" >"$out/$name.log" 2>&1; then
    rm -f "$out/$name.failed"
    echo "$((SECONDS - start)) s" >"$out/$name.done"
  else
    echo "failed after $((SECONDS - start)) s" >"$out/$name.failed"
    failed=1
  fi
}

speed=("$python" -m gsgan.bench speed device=cuda size=full)
# the default person, traced small and enlarged: tracing at 512² would take most of the time
data=(data=synthetic data.source.size=128 data.source.train_cameras=4 data.source.test_cameras=1
  data.source.frames=12 data.source.test_frames=2 data.source.rays_per_pixel=4)
count=$("$python" -c 'import torch; print(torch.cuda.device_count())')

step parity 180 "$python" -m pytest -q -p no:cacheprovider tests/train/test_cuda.py
step tests 360 "$python" -m pytest -q -p no:cacheprovider -n auto tests
step raster 120 "$python" scripts/bench/raster.py device=cuda 'backends=[torch,gsplat]' \
  'gaussians=[8000]' 'sizes=[512]' 'channels=[3,32]' repeats=5 out="$out/raster"
step speed_512 60 "${speed[@]}" hydra.run.dir="$out/speed_512"
step speed_512_bf16 60 "${speed[@]}" precision=bf16-mixed hydra.run.dir="$out/speed_512_bf16"
step speed_1024_bf16 60 "${speed[@]}" size.image=1024 precision=bf16-mixed \
  hydra.run.dir="$out/speed_1024_bf16"
step ddp_1 90 "$python" -m gsgan.train experiment=smoke trainer=ddp trainer.devices=1 \
  evaluate=false resume=false hydra.run.dir="$out/ddp_1"
if ((${count:-1} > 1)); then
  step ddp_2 120 "$python" -m gsgan.train experiment=smoke trainer=ddp trainer.devices=2 \
    evaluate=false resume=false hydra.run.dir="$out/ddp_2"
fi
# the lines of a run have its iterations a second; the stand-in is a smaller network than VGG-16
step paper 300 "$python" -m gsgan.train experiment=paper "${data[@]}" data.size=512 \
  training.perceptual.weights=auto training.schedule.segmentation=50 \
  training.schedule.step_one=200 training.schedule.step_two=200 training.schedule.epoch=50 \
  trainer.check_val_every_n_epoch=1 data.val_images=2 evaluate=false resume=false \
  hydra.run.dir="$out/paper"

card=$(nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader || echo unknown)
{
  echo "# On a GPU"
  echo
  echo "$(date -u +%F), commit $(git rev-parse --short HEAD || echo unknown): ${card//$'\n'/; }" \
    "(name, driver, memory). Written by \`make gpu\` (scripts/gpu_check.sh)."
  for name in "${steps[@]}"; do
    echo -e "\n## ${name//_/ }\n"
    echo "\`$(cat "$out/$name.command" 2>/dev/null)\`: $(cat "$out/$name".{done,failed} 2>/dev/null)"
    if [[ -e $out/$name/speed.md ]]; then
      echo && tail -n +2 "$out/$name/speed.md"
    elif [[ -e $out/$name.log ]]; then
      echo -e '\n```'
      tail -n 25 "$out/$name.log"
      echo '```'
    fi
  done
} >"$page"
echo "gpu_check: written to $page"
exit $failed
