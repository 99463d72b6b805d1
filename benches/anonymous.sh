#!/usr/bin/env bash
# Measures the peak anonymous memory of a command and prints it in KiB on stderr (Linux): benches/anonymous.sh COMMAND...
"$@" &
pid=$!
peak=0
while kill -0 $pid 2>/dev/null; do
    now=$(awk '/^RssAnon/ {print $2}' /proc/$pid/status 2>/dev/null)
    [ "${now:-0}" -gt "$peak" ] && peak=$now
    sleep 0.1
done
wait $pid
code=$?
echo "peak anonymous memory: $peak KiB" >&2
exit $code
