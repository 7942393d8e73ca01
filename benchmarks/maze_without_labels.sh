#!/usr/bin/env bash
# The policies that the records bead-maze-encoders and bead-maze-seeds judge: the maze by each encoder's frozen
# embedding (Sparsh's task T5), by the wrench read out of it, and by touch that is learned with the policy.
# Some five hours of one core, estimated. Stopped, the same line goes on.
set -eu

demos() { touchgoal collect-demos --task bead-maze --env.disturbance 0.003 --resume "$@"; }
demos --env.split validation --env.n-wires 16 --episodes 12 --seed 20000 --out runs/maze/validation
demos --env.n-wires 260 --episodes 130 --out runs/maze/train
both=(--data runs/maze/train/episodes --validation runs/maze/validation/episodes)

train() { # command, name, options
    [ -d "runs/$2/encoder" ] || [ -d "runs/$2/policy" ] && return
    local resume=()
    [ -f "runs/$2/checkpoint.pt" ] && resume=(--resume)
    # shellcheck disable=SC2086 # the command is several words
    touchgoal $1 "${both[@]}" "${@:3}" --out "runs/$2" "${resume[@]}"
}

# Each some ten minutes of one core, with what all four have in common of Sparsh's: two frames or a clip of a tenth of a second.
train "train-encoder mae" maze-mae --frames 20 --stride 2 --mae.stacked --mae.no-bottleneck --mae.mask-ratio 0.75 \
    --mae.epochs 14
train "train-encoder dino" maze-dino --frames 20 --stride 2 --dino.local-views 4 --dino.epochs 5
train "train-encoder ijepa" maze-ijepa --frames 20 --stride 2 --ijepa.epochs 12
train "train-encoder vjepa" maze-vjepa --frames 20 --stride 1 --vjepa.epochs 5
[ -d runs/maze-untrained/encoder ] || python - <<'EOF'
from pathlib import Path

import torch

from touchgoal.encoders import pretrained
from touchgoal.encoders.ssl.untrained import backbone_for

torch.manual_seed(0)
backbone = backbone_for("mae", "compact", "gelsight_mini_markers", stride=2)
pretrained.save(backbone, Path("runs/maze-untrained/encoder"), {"untrained": "random weights, seed 0"})
EOF

policy() { # name, options
    train train-policy "$1" --task bead-maze --head regression --observation-horizon 4 --arm-state commanded \
        --train.lr 1e-3 --train.epochs 10 --trials 0 "${@:2}"
}

for name in untrained mae dino ijepa vjepa; do
    policy "maze-half-$name" --share 0.5 --encoder "runs/maze-$name/encoder" --touch-input embedding
done
policy maze-half-aligned --share 0.5 --encoder gelsight_mini_markers_offline --touch-input embedding
policy maze-half-shipped --share 0.5 --encoder gelsight_mini_markers_mae --touch-input embedding
policy maze-half-wrench --share 0.5 --encoder gelsight_mini_markers_mae
policy maze-half-end-to-end --share 0.5 --end-to-end
