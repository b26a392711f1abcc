#!/usr/bin/env bash
# The whole way on a bundled photo set: set-up, photos -> scene, scene -> motion. Leaves runs/demo/rollout/rollout.rrd.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh
sdfsim=.venv/bin/sdfsim

echo "1/2  reconstructing samples/photos/table_vase (the table is 1.2 m wide)"
# Two corners of the table, as one of the photos shows them.
"$sdfsim" reconstruct samples/photos/table_vase -o runs/demo/scene --preset quick \
    --distance 041.jpg:68,364 041.jpg:574,341 1.2

echo "2/2  dropping a body onto it"
"$sdfsim" simulate runs/demo/scene/scene.yaml -o runs/demo/rollout

cat <<'TEXT'

Watch it:                 .venv/bin/sdfsim view runs/demo/rollout/rollout.rrd
in the browser:           .venv/bin/sdfsim view runs/demo/rollout/rollout.rrd --web
without a screen:         .venv/bin/sdfsim view runs/demo/rollout/rollout.rrd --screenshot demo.png --at 1.0
cameras and surface:      .venv/bin/sdfsim view runs/demo/scene/reconstruction.rrd
TEXT
