#!/usr/bin/env bash
# Checks and measures one GPU: every op, the training step, PSNR against time, frames per second. Under 10 minutes.
# usage: benches/gpu.sh DIORAMA DEVICE DATA OUT
#   DEVICE is cuda, vulkan, metal or webgpu; DATA contains fox/ and lego/; JSON files are written to OUT, a table to stdout.
set -euo pipefail
diorama=$1 device=$2 data=$3 out=$4
mkdir -p "$out"
{
    date -u +%F
    nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader 2>/dev/null || true
    "$diorama" doctor
} >"$out/machine.txt"
# Memory in use on the card, sampled during all measurements.
if command -v nvidia-smi >/dev/null; then
    nvidia-smi --query-gpu=memory.used --format=csv,noheader -lms 200 >"$out/memory.csv" &
    trap 'kill %1' EXIT
fi
wrong=0
"$diorama" bench check --device "$device" --data "$data/fox" --json >"$out/check-$device.json" || wrong=$?
"$diorama" bench ops --device "$device" --json >"$out/ops-$device.json"
for scene in fox lego; do
    case $scene in
    fox) how=(--split every:8) background=auto ;;
    lego) how=(--split file) background=white ;;
    esac
    "$diorama" bench train "$data/$scene" "${how[@]}" --set background=$background --device "$device" --warmup 1000 --steps 200 --json \
        >"$out/train-$scene-$device.json"
    for seconds in ${SECONDS_LIST:-1 2 5 10 30}; do
        run=$out/run-$scene
        "$diorama" train "$data/$scene" -o "$run" "${how[@]}" --background $background --device "$device" --seconds "$seconds" \
            --force --json >"$out/$scene-$seconds-s-$device.json" 2>/dev/null
        "$diorama" eval "$run" --device "$device" --json >"$out/$scene-$seconds-s-psnr-$device.json" 2>/dev/null
        echo "$scene $seconds s: $(grep -o '"psnr":[0-9.]*' "$out/$scene-$seconds-s-psnr-$device.json" | head -1)"
    done
    "$diorama" bench render "$run" --device "$device" --repeats 3 --json >"$out/render-$scene-$device.json"
    rm -rf "$run"
done
exit "$wrong"
