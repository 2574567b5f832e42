#!/usr/bin/env bash
# Every check that needs CUDA, in at most 20 minutes, and docs/results/gpu.md from what it printed.
# A step that is done is not repeated: run it again after an interruption, or after
# removing outputs/gpu_check/<step>.done.  PYTHON, OUT and PAGE replace the defaults below.
# GPU_CHECK_DEVICE=cpu rehearses it on a CPU: the same steps, as small as they go.
# --dry prints every step with its command and its limit, and runs none: no GPU is needed.
set -euo pipefail
cd "$(dirname "$0")/.."
export GPU_CHECK_DEVICE=${GPU_CHECK_DEVICE:-cuda}
device=$GPU_CHECK_DEVICE
folder=outputs/gpu_check result=docs/results/gpu.md
[[ $device == cpu ]] && folder=outputs/gpu_rehearsal result=outputs/gpu_rehearsal/gpu.md
python=${PYTHON:-.venv/bin/python} out=${OUT:-$folder} page=${PAGE:-$result}
limit=1200 slack=1 # seconds of all steps together; factor on each step's
[[ $device == cpu ]] && limit=3600 slack=5
dry=
[[ ${1:-} == --dry ]] && dry=1
if [[ ! $dry && $device == cuda ]] &&
  ! "$python" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'; then
  echo "gpu_check: torch finds no CUDA device on this machine, so nothing was checked."
  exit 1
fi
[[ $dry ]] || mkdir -p "$out"
began=$SECONDS failed=0 steps=()

# step NAME SECONDS COMMAND...: runs it once, for at most so long; its output goes to NAME.log
step() {
  local name=$1 most=$((slack * $2)) left=$((limit - SECONDS + began)) start=$SECONDS
  shift 2
  steps+=("$name")
  if [[ $dry ]]; then
    echo "$name, at most $most s: $*"
    return
  fi
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

speed=("$python" -m gsgan.bench speed device="$device" size=full)
# the default person, traced small and enlarged: tracing at 512² would take most of the time
data=(data=synthetic data.source.size=128 data.source.train_cameras=4 data.source.test_cameras=1
  data.source.frames=12 data.source.test_frames=2 data.source.rays_per_pixel=4)
trainer=gpu ddp=(trainer=ddp) suite=(-n auto tests) fit=() demo=() video=()
raster=('backends=[torch,gsplat]' 'gaussians=[8000]' 'sizes=[512]' 'channels=[3,32]' repeats=5)
paper=(data.size=512 training.schedule.segmentation=50 training.schedule.step_one=200
  training.schedule.step_two=200 training.schedule.epoch=50)
count=$("$python" -c 'import torch; print(torch.cuda.device_count())')
if [[ $device == cpu ]]; then
  speed=("${speed[@]/size=full/size=tiny}" frames=2 warmup=1 poses=2)
  data=(data=synthetic data.source.size=32 data.source.train_cameras=2 data.source.test_cameras=1
    data.source.frames=4 data.source.test_frames=1 data.source.rays_per_pixel=1)
  quick=(fit.points=400 fit.surface_steps=4 fit.sweeps=2) suite=(tests/test_scene.py)
  trainer=cpu ddp=(trainer=ddp trainer.accelerator=cpu "${data[@]}" "${quick[@]}")
  fit=(size.image=48 "${quick[@]}") demo=(size=tiny "${quick[@]}") video=(frames=3)
  raster=('backends=[torch]' 'gaussians=[500]' 'sizes=[64]' 'channels=[3]' repeats=1)
  paper=(size=tiny data.size=32 training.schedule.segmentation=2 training.schedule.step_one=2
    training.schedule.step_two=2 training.schedule.epoch=2)
fi
tests=("$python" -m pytest -q -p no:cacheprovider)

step parity 180 "${tests[@]}" tests/train/test_cuda.py
step devices 180 "${tests[@]}" tests/train/test_devices.py tests/view/test_session.py
step tests 360 "${tests[@]}" "${suite[@]}"
step raster 120 "$python" scripts/bench/raster.py device="$device" "${raster[@]}" out="$out/raster"
step speed_512 60 "${speed[@]}" hydra.run.dir="$out/speed_512"
step speed_512_bf16 60 "${speed[@]}" precision=bf16-mixed hydra.run.dir="$out/speed_512_bf16"
step speed_1024_bf16 60 "${speed[@]}" size.image=1024 precision=bf16-mixed \
  hydra.run.dir="$out/speed_1024_bf16"
step fit 120 "$python" -m gsgan.fit "${data[@]}" "${fit[@]}" out="$out/fit" overwrite=true \
  device="$device"
# the default avatar (body, hands, S), its body fitted before training on the device
step person 180 "$python" -m gsgan.train experiment=demo_256 training=smoke trainer=$trainer \
  trainer.precision=bf16-mixed "${data[@]}" "${demo[@]}" resume=false hydra.run.dir="$out/person"
step render 60 "$python" -m gsgan.render run="$out/person" motion=novel_pose drive=skeleton \
  "${video[@]}" out="$out/render.mp4" overwrite=true device="$device"
step ddp_1 90 "$python" -m gsgan.train experiment=smoke "${ddp[@]}" trainer.devices=1 \
  evaluate=false resume=false hydra.run.dir="$out/ddp_1"
if ((${count:-1} > 1)); then
  step ddp_2 120 "$python" -m gsgan.train experiment=smoke "${ddp[@]}" trainer.devices=2 \
    evaluate=false resume=false hydra.run.dir="$out/ddp_2"
fi
# the lines of a run have its iterations a second
step paper 300 "$python" -m gsgan.train experiment=paper trainer=$trainer \
  trainer.precision=bf16-mixed "${data[@]}" "${paper[@]}" \
  trainer.check_val_every_n_epoch=1 data.val_images=2 evaluate=false resume=false \
  hydra.run.dir="$out/paper"

[[ $dry ]] && exit 0
[[ $device == cuda ]] && title="On a GPU" || title="A rehearsal on a CPU"
card=$(nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader 2>/dev/null || echo unknown)
{
  echo "# $title"
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
