#!/usr/bin/env bash
# The policies that the record maze-steps judges: heads that denoise in one step or in four, and a regression, on one
# set of recordings: those of `make maze-policy` with two rounds of corrections (160 demonstrations, 151 corrected
# episodes). Some twenty minutes of one core, estimated.
set -eu

policy() { # name, options
    [ -d "runs/maze-steps/$1/policy" ] && return
    touchgoal train-policy --task bead-maze --train.snapshot-epochs 5 --refuse-unknown-touch --touch-noise 0.5 \
        --action-share 0.98 --encoder gelsight_mini_markers_mae --trials 0 --env.start-angle 10 --env.as-deployed \
        --data runs/maze/train/episodes --validation runs/maze/val/episodes "${@:2}" --out "runs/maze-steps/$1"
}

five=(--train.epochs 3)
policy one "${five[@]}" --sampler.num-inference-steps 1
policy four "${five[@]}" --sampler.num-inference-steps 4
policy flow --sampler.kind flow --sampler.num-inference-steps 4 --train.epochs 3
policy regression --head regression --train.epochs 5
