#!/usr/bin/env bash
# Measures this machine's CPU: ops, the training step on fox and lego, and the lower instruction sets.
# usage: benches/cpu.sh DIORAMA DATA OUT     DATA contains fox/ and lego/; one JSON file per figure is written to OUT.
set -euo pipefail
diorama=$1 data=$2 out=$3
mkdir -p "$out"
{
    date -u +%F
    grep -m1 'model name' /proc/cpuinfo | cut -d: -f2- || true
    nproc
    grep MemTotal /proc/meminfo
} >"$out/machine.txt"
fox=(bench train "$data/fox" --downscale 4 --split every:8 --device cpu --warmup 800 --steps 200 --json)
lego=(bench train "$data/lego" --set background=white --device cpu --warmup 800 --steps 200 --json)
"$diorama" bench ops --threads 1 --json >"$out/ops-1-thread.json"
"$diorama" bench ops --threads 2 --json >"$out/ops-2-threads.json"
for threads in 1 2; do
    "$diorama" "${fox[@]}" --threads $threads >"$out/train-fox-$threads.json"
    "$diorama" "${lego[@]}" --threads $threads >"$out/train-lego-$threads.json"
done
for level in portable avx2; do
    DIORAMA_SIMD=$level "$diorama" bench ops --threads 1 --json >"$out/ops-$level.json"
    DIORAMA_SIMD=$level "$diorama" "${fox[@]}" --threads 2 >"$out/train-fox-$level.json"
done
