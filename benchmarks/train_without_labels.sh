#!/usr/bin/env bash
# The encoders without labels that the records real-touch-without-labels, tacbench-slides and tacbench-pose
# judge: each objective on simulated slides, on real videos and on both; and on slides of a Mini with markers.
# About two hours of one core. What is there already is left alone.
#
#     benchmarks/train_without_labels.sh PHYSICLEAR     the folder with videos/ and labels.csv
set -eu
videos=${1:?usage: benchmarks/train_without_labels.sh FOLDER_OF_PHYSICLEAR}

slides() { # name, options of collect-touches
    [ -d "runs/$1" ] || touchgoal collect-touches --out "runs/$1" "${@:2}"
}
train() { # name, options of train-encoder
    [ -d "runs/$1/encoder" ] || touchgoal train-encoder "${@:2}" --out "runs/$1"
}

slides slides
slides slides-validation --episodes 24 --seed 1
slides slides-plain --sensor gelsight_mini
slides slides-plain-validation --sensor gelsight_mini --episodes 24 --seed 1

mae="--mae.stacked --mae.no-bottleneck --mae.mask-ratio 0.75 --mae.epochs 8"
dino="--dino.local-views 4 --dino.epochs 4"
ijepa="--ijepa.epochs 6"
vjepa="--vjepa.epochs 5"

markers="--data runs/slides/episodes --validation runs/slides-validation/episodes"
train slides-mae mae $markers --stride 5 --frames 20 $mae
train slides-dino dino $markers --stride 5 --frames 20 $dino
train slides-ijepa ijepa $markers --stride 5 --frames 20 $ijepa
train slides-vjepa vjepa $markers --stride 2 --frames 10 $vjepa

# As many touches of each kind of data, but for rounding: 3,000 or so, 1,500 clips.
simulated="--data runs/slides-plain/episodes --validation runs/slides-plain-validation/episodes"
real="--data $videos"
both="--data runs/slides-plain/episodes $videos --validation runs/slides-plain-validation/episodes"
for kind in simulated real both; do
    [ $kind = both ] && frames=5 clips=3 || { frames=10 clips=5; }
    train mae-$kind mae ${!kind} --stride 2 --frames $frames $mae
    train dino-$kind dino ${!kind} --stride 2 --frames $frames $dino
    train ijepa-$kind ijepa ${!kind} --stride 2 --frames $frames $ijepa
    train vjepa-$kind vjepa ${!kind} --stride 1 --frames $clips $vjepa
done
