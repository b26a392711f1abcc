#!/usr/bin/env bash
# All steps on a bundled photo set: set-up, photos -> scene, scene -> motion. A ball knocks a vase off a table.
# Usage: bash scripts/demo.sh [FOLDER]   (default: runs/demo)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh
out="${1:-runs/demo}"
sdfsim=.venv/bin/sdfsim

echo "1/3  reconstructing samples/photos/table_vase (the table is 1.2 m wide)"
# Two corners of the table in one of the photos.
"$sdfsim" reconstruct samples/photos/table_vase -o "$out/scene" --preset quick --drop none \
    --distance 026.jpg:50,200 026.jpg:428,370 1.2

echo "2/3  throwing a ball at the vase"
.venv/bin/python samples/knock.py "$out/scene" object1
"$sdfsim" simulate "$out/scene/knock.yaml" -o "$out/rollout"

echo "3/3  taking a picture"
picture="$out/rollout/rollout.png"
"$sdfsim" render "$out/rollout" -o "$picture" --at 0.4

cat <<TEXT

A picture of it:          $picture
Play with it:             $sdfsim play $out/scene
a page to send:           $sdfsim export $out/rollout -o run.html
a movie of it:            $sdfsim render $out/rollout -o movie.mp4
Watch it with plots:      $sdfsim view $out/rollout --web
cameras and surface:      $sdfsim view $out/scene/reconstruction.rrd
by the graph network:     $sdfsim simulate $out/scene/knock.yaml --model gnn -o $out/gnn
TEXT
