#!/usr/bin/env bash
# Trains every capture with the defaults and prints one table, so that no default is chosen on one capture alone:
#
#     benches/captures.sh [--seconds 120] [--out FOLDER] CAPTURE[:DOWNSCALE]… [-- OPTIONS OF diorama train]
#
# DIORAMA names the program (target/release/diorama). Runs, scores, and renders beside photographs are written to FOLDER
# (target/captures). An existing run is scored again, not trained again.
set -euo pipefail
diorama="${DIORAMA:-target/release/diorama}" seconds=120 out=target/captures
captures=() options=()
while [ $# -gt 0 ]; do
    case "$1" in
    --seconds) seconds="$2" && shift 2 ;;
    --out) out="$2" && shift 2 ;;
    --) shift && options=("$@") && break ;;
    -*) echo "captures.sh: unknown option $1" >&2 && exit 2 ;;
    *) captures+=("$1") && shift ;;
    esac
done
[ "${#captures[@]}" -gt 0 ] || { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2 && exit 2; }
mkdir -p "$out"
echo "| Capture | Steps | Rays, millions | Held-out / training dB | Worst | After the affine map | SSIM | Views behind fog |"
echo "|---|---|---|---|---|---|---|---|"
for capture in "${captures[@]}"; do
    path="${capture%:*}" downscale="${capture##*:}"
    [ "$path" != "$capture" ] || downscale=4
    name="$(basename "$path")"
    run="$out/$name"
    if [ ! -e "$run/summary.json" ]; then
        "$diorama" train "$path" -o "$run" --downscale "$downscale" --split every:8 --seconds "$seconds" "${options[@]}" \
            >"$run.log" 2>&1 || { tail -n 1 "$run.log" >&2 && exit 1; }
    fi
    "$diorama" eval "$run" --save-images --json >"$run.json" 2>>"$run.log"
    python3 - "$name, 1/$downscale" "$run" <<'PY'
import json, sys

name, run = sys.argv[1:]
scores = json.load(open(run + ".json"))
steps = [json.loads(line) for line in open(run + "/metrics.jsonl")]
last = [s for s in steps if s.get("rays")][-1]
views = scores["per_view"]
fog = sum(v["behind_fog"] is True for v in views)
training = scores["training"]["psnr"]
print(
    f"| {name} | {last['step']} | {last['rays'] / 1e6:.1f} | {scores['psnr']:.2f} / {training:.2f} | {scores['psnr_min']:.2f} "
    f"| {scores['psnr_affine']:.2f} | {scores['ssim']:.3f} | {fog} of {len(views)} |"
)
PY
done
