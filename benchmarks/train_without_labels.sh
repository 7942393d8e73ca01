#!/usr/bin/env bash
# The encoders without labels that the records real-touch-without-labels, tacbench-pose and tacbench-long
# judge: each objective on simulated slides, on real videos and on both; and on slides of a Mini with markers.
# Two to three hours of one core, estimated, and two hours of two cores for each of the last four
# (with DEVICE=cuda an H200 trained these four in 5 minutes). Stopped, the same line goes on.
#
#     benchmarks/train_without_labels.sh PHYSICLEAR     the folder with videos/ and labels.csv
set -eu
videos=${1:?usage: benchmarks/train_without_labels.sh FOLDER_OF_PHYSICLEAR}

train() { # name, options of train-encoder
    [ -d "runs/$1/encoder" ] && return
    local resume=()
    [ -f "runs/$1/checkpoint.pt" ] && resume=(--resume)
    touchgoal train-encoder "${@:2}" --device "${DEVICE:-cpu}" --out "runs/$1" "${resume[@]}"
}

# What is recorded already is not recorded again.
touchgoal collect-touches --body slide --out runs/slides
touchgoal collect-touches --body slide --out runs/slides-validation --episodes 24 --seed 1
touchgoal collect-touches --body slide --out runs/slides-plain --sensor gelsight_mini
touchgoal collect-touches --body slide --out runs/slides-plain-validation --sensor gelsight_mini --episodes 24 --seed 1

mae=(--mae.stacked --mae.no-bottleneck --mae.mask-ratio 0.75 --mae.epochs 8)
dino=(--dino.local-views 4 --dino.epochs 4)
ijepa=(--ijepa.epochs 6)
vjepa=(--vjepa.epochs 5)

markers=(--data runs/slides/episodes --validation runs/slides-validation/episodes)
train slides-dino dino "${markers[@]}" --stride 5 --frames 20 "${dino[@]}"

four() { # kind of data, moments and clips of each recording, options that name the data
    train "mae-$1" mae "${@:4}" --stride 2 --frames "$2" "${mae[@]}"
    train "dino-$1" dino "${@:4}" --stride 2 --frames "$2" "${dino[@]}"
    train "ijepa-$1" ijepa "${@:4}" --stride 2 --frames "$2" "${ijepa[@]}"
    train "vjepa-$1" vjepa "${@:4}" --stride 1 --frames "$3" "${vjepa[@]}"
}

# As many touches of each kind of data, but for rounding: 3,000 or so, 1,500 clips.
plain=runs/slides-plain/episodes validation=runs/slides-plain-validation/episodes
four simulated 10 5 --data "$plain" --validation "$validation"
four real 10 5 --data "$videos"
four both 5 3 --data "$plain" "$videos" --validation "$validation"

touchgoal collect-touches --body slide --out runs/slides-long --episodes 1200
long=(--data runs/slides-long/episodes --validation runs/slides-validation/episodes)
train long-mae mae "${long[@]}" --stride 5 --frames 20 "${mae[@]}" --mae.epochs 12
train long-dino dino "${long[@]}" --stride 5 --frames 20 "${dino[@]}" --dino.epochs 6
train long-ijepa ijepa "${long[@]}" --stride 5 --frames 20 --ijepa.epochs 10
train long-vjepa vjepa "${long[@]}" --stride 2 --frames 10 --vjepa.epochs 8
