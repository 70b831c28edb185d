#!/usr/bin/env bash
# Measure everything that needs a GPU, in at most fifteen minutes:
#
#     bash benchmarks/gpu.sh OUT
#
# OUT, a new folder, gets a log of each part and the metrics of the benchmarks as JSON:
#     planner      time per plan of 1024 candidates x 4 steps x 3 iterations
#     collect      rate of the collection on all CPU cores
#     train_step   gradient steps and frames per second by batch size
#     train        README's training, stopped after four minutes
#     eval         success of its policy
#     lowlevel     training rate of the low-level controller in mjlab
# A part that fails does not stop the others; the exit code is then 1. Without a GPU all parts run on
# the CPU, at sizes that only test this script.
set -uo pipefail
cd "$(dirname "$0")/.." || exit 2
PATH=$PWD/.venv/bin:$PATH
out=${1:?name a new folder}
mkdir -- "$out" || exit 2
out=$(realpath -- "$out")
failed=0

part() {  # part NAME LIMIT_S COMMAND...
  local name=$1 limit=$2 start=$SECONDS code=0
  shift 2
  timeout "$limit" "$@" >"$out/$name.log" 2>&1 || code=$?
  echo "== $name: exit code $code, $((SECONDS - start)) s: $*"
  tr '\r' '\n' <"$out/$name.log" | tail -n 20
  [ "$code" = 0 ] || failed=1
}

policy=$out/policy/checkpoints/last/pretrained_model
collect=(egovcp-collect --task=all --dataset.root="$out/data")
train=(egovcp-train --dataset.root="$out/data" --output_dir="$out/policy" --tensorboard=false)
eval=(egovcp-eval --policy.path="$policy" --task=all --controllers=planner,oracle
  --output_dir="$out/eval" --seed=20)
if python -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'; then
  part planner 60 python benchmarks/planner.py --rounds 200 --json "$out/planner.json"
  part collect 200 "${collect[@]}" --episodes=13600
  part train_step 120 python benchmarks/train_step_gpu.py --root "$out/data" --batches 32 64 256 \
    --cpu_batches --rounds 5 --json "$out/train_step.json"
  part train 270 "${train[@]}" --max_minutes=4
  part eval 90 "${eval[@]}" --episodes=100
  part lowlevel 120 train Egovcp-LowLevel-Unitree-G1 --env.scene.num-envs 4096 \
    --agent.max-iterations 20
else
  echo "no GPU: sizes that only test this script"
  brief=(--env.{ball,wall}_episode="{ticks: 30, event_ticks: [4, 20]}" --env.arch_episode.ticks=30)
  part planner 90 python benchmarks/planner.py --rounds 2 --samples 32 --json "$out/planner.json"
  part collect 300 "${collect[@]}" --episodes=12 "${brief[@]}"
  part train_step 150 python benchmarks/train_step.py --root "$out/data" --batches 2 --threads 1 \
    --rounds 1 --json "$out/train_step.json"
  part train 330 "${train[@]}" --preset=debug --steps=2 --batch_size=2 --sampling.length=9 \
    --returns.steps=6 --planner.samples=32 --planner.elites=8
  part eval 120 "${eval[@]}" --episodes=1 "${brief[@]}"
  part lowlevel 180 egovcp-train-lowlevel --steps=200 --robots=4 --tensorboard=false \
    --output_dir="$out/lowlevel"
fi
exit "$failed"
