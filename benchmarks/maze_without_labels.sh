#!/usr/bin/env bash
# The policies that the records bead-maze-encoders, -seeds, -embedding, -learned and -single judge: the maze by each
# encoder's frozen embedding (Sparsh's task T5), and by touch that is learned with the policy; of half of 130
# demonstrations, and two of them of all, with three seeds; then the table by data, touch and head, and one wire
# alone. Some five hours of one core, estimated. Stopped, the same line goes on. The first two records also hold
# policies that read a wrench, which train-policy no longer makes.
set -eu

demos() { # name, options
    [ -f "runs/maze/$1/metrics.json" ] ||
        touchgoal collect-demos --task bead-maze --env.disturbance 0.003 "${@:2}" --out "runs/maze/$1"
}
demos validation --env.split validation --env.n-wires 16 --episodes 12 --seed 20000
demos train --env.n-wires 260 --episodes 130
both=(--data runs/maze/train/episodes --validation runs/maze/validation/episodes)

train() { # command, name, options
    [ -d "runs/$2/encoder" ] || [ -d "runs/$2/policy" ] && return
    local resume=()
    [ -f "runs/$2/checkpoint.pt" ] && resume=(--resume)
    # shellcheck disable=SC2086 # the command is several words
    touchgoal $1 "${both[@]}" "${@:3}" --out "runs/$2" "${resume[@]}"
}

# Each some ten minutes of one core; two frames 0.1 s apart, as Sparsh's are 0.08 s, or a clip of 0.15 s.
train "train-encoder mae" maze-mae --frames 20 --stride 2 --mae.stacked --mae.no-bottleneck --mae.mask-ratio 0.75 \
    --mae.epochs 14
train "train-encoder dino" maze-dino --frames 20 --stride 2 --dino.local-views 4 --dino.epochs 5
train "train-encoder ijepa" maze-ijepa --frames 20 --stride 2 --ijepa.epochs 12
train "train-encoder vjepa" maze-vjepa --frames 20 --stride 1 --vjepa.epochs 5
[ -d runs/maze-untrained/encoder ] || python - <<'EOF'
from pathlib import Path

import torch

from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.sparsh import backbone_for

torch.manual_seed(0)
backbone = backbone_for("mae", "compact", "gelsight_mini_markers", stride=2)
pretrained.save(backbone, Path("runs/maze-untrained/encoder"), {"untrained": "random weights, seed 0"})
EOF

policy() { # name, options
    train train-policy "$1" --task bead-maze --head regression --arm-state commanded \
        --train.epochs 5 --trials 0 "${@:2}"
}

for name in untrained mae dino ijepa vjepa; do
    policy "maze-half-$name" --share 0.5 --encoder "runs/maze-$name/encoder"
done
policy maze-half-aligned --share 0.5 --encoder gelsight_mini_markers
policy maze-half-shipped --share 0.5 --encoder gelsight_mini_markers_mae
policy maze-half-end-to-end --share 0.5 --encoder end-to-end

# Of all the demonstrations, three training seeds: the embedding of the least validation
# loss above, and touch learned with the policy.
for seed in 0 1 2; do
    policy "maze-all-shipped-$seed" --seed "$seed" --encoder gelsight_mini_markers_mae
    policy "maze-all-end-to-end-$seed" --seed "$seed" --encoder end-to-end
done

# The table by data, touch and head (records bead-maze-embedding and -learned): a tenth, half and all of
# the demonstrations, one seed; of all of them diffusion, and flow on the embedding, with three. Regression on half
# and all of them is above.
sampled=(--head mlp --action-share 0.98 --sampler.num-train-timesteps 100 --sampler.num-inference-steps 2)
declare -A touches=(
    [embedding]="--encoder gelsight_mini_markers_mae"
    [end-to-end]="--encoder end-to-end"
)
for share in 0.1 0.5 1; do
    for touch in embedding end-to-end; do
        # shellcheck disable=SC2206 # several words
        inputs=(${touches[$touch]} --share "$share")
        [ "$share" != 0.1 ] || policy "maze-$share-$touch-regression-0" "${inputs[@]}"
        policy "maze-$share-$touch-diffusion-0" "${inputs[@]}" "${sampled[@]}"
        policy "maze-$share-$touch-flow-0" "${inputs[@]}" "${sampled[@]}" --sampler.kind flow \
            --sampler.num-inference-steps 4
    done
done
for seed in 1 2; do
    for touch in embedding end-to-end; do
        # shellcheck disable=SC2086
        policy "maze-1-$touch-diffusion-$seed" --seed "$seed" ${touches[$touch]} "${sampled[@]}"
    done
    # shellcheck disable=SC2086
    policy "maze-1-embedding-flow-$seed" --seed "$seed" ${touches[embedding]} "${sampled[@]}" --sampler.kind flow \
        --sampler.num-inference-steps 4
done

# One wire, trained and tested on (record bead-maze-single; Sparsh's appendix C.7).
demos one-wire --env.wires fourier-3 --episodes 50
demos one-wire-validation --env.wires fourier-3 --episodes 5 --seed 90000
both=(--data runs/maze/one-wire/episodes --validation runs/maze/one-wire-validation/episodes)
# shellcheck disable=SC2086
policy maze-one-wire ${touches[embedding]} "${sampled[@]}" --representation body_twist --touch-noise 0.5 \
    --sampler.num-train-timesteps 5 --sampler.num-inference-steps 1 --train.epochs 8
