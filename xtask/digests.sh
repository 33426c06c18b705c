#!/usr/bin/env bash
# Prints a digest of the results of a fixed set of runs, one a line: what a change of structure alone
# must leave as it is. Give it a driver: `xtask/digests.sh target/debug/xtask`.
#
# Times, rates, memory and paths are left out of what is digested. Digests depend on the processor, and a
# driver reads the data sets of the checkout that it was built in: run the drivers of before and after on
# one machine, each in its own checkout.
set -euo pipefail
driver=$(realpath "${1:?the driver to run, for instance target/debug/xtask}")
cd "$(dirname "$0")/.."
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT

mini=datasets/mini
relative=model:datasets/weights/gump-relative.safetensors
tiny=model:datasets/weights/gump-tiny.safetensors

# The results of a run's report without what differs between equal runs.
digest() {
    python3 - "$1" <<'PY'
import hashlib, json, re, sys

SKIP = re.compile(
    r"(^|_)(seconds|ms|milliseconds|wall|rss|memory|bytes|path|file|folder|out)(_|$)"
    r"|(^|_)time$|per_second|^speed_up"
)

def kept(value):
    if isinstance(value, dict):
        return {k: kept(v) for k, v in sorted(value.items()) if not SKIP.search(k)}
    if isinstance(value, list):
        return [kept(v) for v in value]
    return value

results = json.load(open(sys.argv[1]))["results"]
print(hashlib.sha256(json.dumps(kept(results)).encode()).hexdigest()[:16])
PY
}

run() {
    local name=$1
    shift
    if "$driver" "$@" --quiet --out "$out/$name" >"$out/$name.log" 2>&1; then
        echo "$name $(digest "$out/$name/report.json")"
    else
        echo "$name failed: $(tail -1 "$out/$name.log")"
    fi
}

scene=$mini/sumo-hamburg.tfrecord.gz#0
run simulate-relative simulate --scenario $scene --world $relative --futures 4 --seconds 8
run simulate-relative-raw simulate --scenario $mini/procedural.tfrecord.gz#1 --world $relative --futures 3 --seconds 4 --raw
run simulate-tiny simulate --scenario $scene --world $tiny --futures 3 --seconds 4
run simulate-tiny-full-ar simulate --scenario $scene --world $tiny --futures 1 --seconds 2 --mode full-ar
run simulate-tiny-growing simulate --scenario $scene --world $tiny --futures 2 --seconds 4 --cache growing
run simulate-tiny-spawn simulate --scenario $scene --world $tiny --futures 2 --seconds 4 --spawn
run simulate-tiny-int8 simulate --scenario $scene --world $tiny --futures 2 --seconds 3 --precision int8
run simulate-idm simulate --scenario $scene --world idm --futures 2 --seconds 8
run generate generate --map $mini/procedural.tfrecord.gz#0 --vehicles 8 --pedestrians 2 --count 2 --simulate 2
run generate-prompt generate --map $mini/sumo-hamburg.tfrecord.gz#1 --prompt high_magnitude_speed --count 1
# The first two scenes of a file, so that evaluations take seconds.
python3 - $mini/sumo-hamburg.tfrecord.gz "$out/scenes.tfrecord" <<'PY'
import gzip, struct, sys

data, end = gzip.open(sys.argv[1]).read(), 0
for _ in range(2):
    end += 12 + struct.unpack_from("<Q", data, end)[0] + 4
open(sys.argv[2], "wb").write(data[:end])
PY
scenes=$out/scenes.tfrecord
run evaluate-wosac evaluate wosac --scenarios $scenes --world $relative --futures 8
run evaluate-motion evaluate motion --scenarios $scenes --world idm
run evaluate-behaviour evaluate behaviour --scenarios $scenes --world $relative --futures 4
# Scenes in which somebody is near an ego that leaves its log.
run evaluate-reactions evaluate reactions --scenarios $mini/procedural.tfrecord.gz --limit 2 --world log,idm,$relative --futures 2
run evaluate-closed-loop evaluate closed-loop --scenarios $scenes --planner pdm-closed --world idm

# A few steps of training, of both networks; the weights themselves are digested, without the headers
# of their files.
train() {
    local name=$1
    shift
    if "$driver" train "$@" --quiet --threads 1 --out "$out/$name" >"$out/$name.log" 2>&1; then
        python3 - "$name" "$out/$name" <<'PY'
import glob, hashlib, json, struct, sys

digest = hashlib.sha256()
for file in sorted(glob.glob(sys.argv[2] + "/**/*.safetensors", recursive=True)):
    data = open(file, "rb").read()
    length = struct.unpack_from("<Q", data)[0]
    header = json.loads(data[8 : 8 + length])
    header.pop("__metadata__", None)
    digest.update(json.dumps(header, sort_keys=True).encode() + data[8 + length :])
print(sys.argv[1], digest.hexdigest()[:16])
PY
    else
        echo "$name failed: $(tail -1 "$out/$name.log")"
    fi
}
sed -e 's/^steps = .*/steps = 8/' -e 's/^drives = .*/drives = 16/' configs/tiny-closed-loop.toml >"$out/tiny.toml"
train train-sequence --config "$out/tiny.toml" --data $mini --from datasets/weights/gump-tiny.safetensors --realism-rollouts 0
cat >"$out/relative.toml" <<'TOML'
model = "relative"
[train]
batch = 2
mixed_precision = true
smoothing_bins = 0.7
[[stage]]
[stage.train]
steps = 6
[[stage]]
[stage.train]
steps = 4
[stage.train.closed_loop]
share = 1.0
ruled = 0.5
candidates = 4
refresh = 2
[[stage]]
[stage.train]
steps = 2
[stage.train.closed_loop]
share = 1.0
[stage.train.realism]
rollouts = 3
agents = 12
refresh = 2
TOML
train train-relative --model relative --config "$out/relative.toml" --data $mini --realism-rollouts 0
