#!/usr/bin/env bash
# Checks and measures the kernels on one GPU.
# usage: benches/gpu.sh DIORAMA DEVICE OUT     DEVICE is cuda, vulkan, metal or webgpu; OUT gets JSON files.
set -euo pipefail
diorama=$1 device=$2 out=$3
mkdir -p "$out"
{
    date -u +%F
    nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader 2>/dev/null || true
    "$diorama" doctor
} >"$out/machine.txt"
wrong=0
"$diorama" bench check --device "$device" --json >"$out/check-$device.json" || wrong=$?
"$diorama" bench ops --device "$device" --json >"$out/ops-$device.json"
exit "$wrong"
