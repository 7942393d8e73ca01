"""What README and docs quote: the command of every figure, and its figure in one line."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from touchgoal.policies.evaluation.success_rate import SuccessRate

Metrics = dict[str, Any]


@dataclass(frozen=True)
class Quoted:
    """One measurement.

    Attributes:
        command: as a user types it.
        claim: what README's table says was measured; "" keeps it out of that table.
        headline: the figure of that row, from what the command wrote to metrics.json.
    """

    command: str
    claim: str = ""
    headline: Callable[[Metrics], str] = lambda metrics: ""


def _successes(metrics: Metrics) -> str:
    return f"{SuccessRate(metrics['successes'], metrics['trials'])} (95 % Wilson)"


def _deployed(metrics: Metrics) -> str:
    done = [row["success"] for row in metrics["deployments"]]
    return f"{SuccessRate(sum(done), len(done))} (95 % Wilson)"


def _maze(metrics: Metrics) -> str:
    trials = metrics["closed_loop"]
    shuffled = next(name for name in trials if name.endswith(", shuffled"))
    own, other = (
        SuccessRate(sum(t["success"] for t in trials[name]), len(trials[name]))
        for name in (shuffled.removesuffix(", shuffled"), shuffled)
    )
    return f"{own}; with the touch of another wire {other}"


def _auc(metrics: Metrics) -> str:
    drop = metrics["auc"]["drop"]
    return f"{drop['image']:.2f} by image, {drop['image+tactile']:.2f} by image and touch"


def _median_rate(start: str, unit: str) -> Callable[[Metrics], str]:
    def headline(metrics: Metrics) -> str:
        rates = [row["median"] for row in metrics["rows"] if row["what"].startswith(start)]
        return f"{min(rates):,.0f} to {max(rates):,.0f} {unit}"

    return headline


def _plan(metrics: Metrics) -> str:
    stage = next(s for s in metrics["stages"] if s["what"].startswith("a whole plan"))
    return f"{stage['median']:.1f} ms, {stage['p95']:.1f} ms at the 95th percentile"


def _realism(metrics: Metrics) -> str:
    def median(sensor: str, method: str) -> float:
        psnr = sorted(
            row["psnr_near"]
            for row in metrics["rows"]
            if (row["sensor"], row["method"]) == (sensor, method)
        )
        return psnr[len(psnr) // 2]

    ours, taxim = "ours, circles corrected", "taxim table, on our background"
    return "; ".join(
        f"{name} {median(sensor, ours):.1f} dB (Taxim's table {median(sensor, taxim):.1f})"
        for name, sensor in (("GelSight", "gelsight"), ("Mini", "gelsight_mini"))
    )


def _real_force(metrics: Metrics) -> str:
    low, high = metrics["median_error_interval"]
    return f"{metrics['median_error']:.1f} N (median; 95 % over things {low:.1f} to {high:.1f})"


def _nearest(metrics: Metrics) -> str:
    row = metrics["rows"][0]
    low, high = row["nearest_interval"]
    return f"{row['nearest']:.2f} (95 % over things {low:.2f} to {high:.2f})"


def _all_right(metrics: Metrics) -> str:
    row = metrics["rows"][0]
    val, folds = row["val"], row["cross_validated"]
    low, high = val["all_interval"]
    return (
        f"{val['all']:.2f} (95 % over {val['things']} things {low:.2f} to {high:.2f}), the probe's strength chosen on these "
        f"things; by ten folds over {folds['things']} things {folds['all']:.2f}"
    )


QUOTED = {
    "real-touch": Quoted(
        "touchgoal benchmark real-touch --data physiclear --encoders gelsight_mini_surfaces "
        "gelsight_mini random:gelsight_mini pixels efficientnet",
        "the nearest other video of a real touch is of the same thing (chance 0.015)",
        _nearest,
    ),
    "real-touch-adapted": Quoted(
        "touchgoal benchmark real-touch --data physiclear --encoders runs/adapted/encoder",
        "after `train-encoder adapt` on other things' videos: hardness, roughness and bumpiness of a real thing all right "
        "(chance 0.04)",
        _all_right,
    ),
    "real-touch-seeds": Quoted(
        "touchgoal benchmark real-touch --data physiclear --encoders runs/surfaces-1/encoder "
        "runs/surfaces-2/encoder"
    ),
    "real-touch-without-labels": Quoted(
        "touchgoal benchmark real-touch --data physiclear --encoders "
        + " ".join(
            f"runs/{name}/encoder"
            for name in (
                "mae-simulated mae-real mae-both dino-simulated dino-real dino-both "
                "ijepa-simulated ijepa-real vjepa-simulated vjepa-real"
            ).split()
        )
        + " random:runs/dino-simulated/encoder random:runs/vjepa-simulated/encoder",
    ),
    "real-touch-without-labels-both": Quoted(
        "touchgoal benchmark real-touch --data physiclear --encoders runs/ijepa-both/encoder runs/vjepa-both/encoder "
        "random:runs/vjepa-both/encoder",
    ),
    "real-force": Quoted(
        "touchgoal benchmark real-touch --data franka_wedge_grasps --encoders gelsight_mini_surfaces pixels",
        "force of real grasps from pictures, of things not calibrated on",
        _real_force,
    ),
    "real-force-rectified": Quoted(
        "touchgoal benchmark real-touch --data franka_wedge_grasps --encoders gelsight_mini_surfaces pixels "
        "--corners 44 66 458 110 56 440 460 382",
    ),
    "real-markers": Quoted("touchgoal benchmark real-touch --data mini_markers"),
    "pick-place": Quoted(
        "touchgoal run-policy --episodes 100 --no-video",
        "the shipped policy picks and places, of 100 scenes it has not seen",
        _successes,
    ),
    "pick-place-as-deployed": Quoted(
        "touchgoal run-policy --episodes 100 --env.as-deployed --no-video",
        "the same with a real arm's delays, lags, hand and force estimate",
        _successes,
    ),
    "pick-place-expert": Quoted(
        "touchgoal run-policy --episodes 100 --policy expert", headline=_successes
    ),
    "deploy-real-time": Quoted(
        "touchgoal benchmark deploy --tasks pick-place --policies shipped --arms real-time --episodes 20 "
        "--seed 7000000",
        "the shipped policy through libfranka's protocol, on fresh twins in real time",
        _deployed,
    ),
    "deploy-pick-place": Quoted(
        "touchgoal benchmark deploy --tasks pick-place --policies shipped --arms environment in-process "
        "lock-step --episodes 40 --seed 7000000",
    ),
    "deploy-bead-maze": Quoted(
        "touchgoal benchmark deploy --tasks bead-maze --policies shipped --arms environment in-process "
        "lock-step --episodes 40 --seed 7000000",
    ),
    "deploy-maze-real-time": Quoted(
        "touchgoal benchmark deploy --tasks bead-maze --policies shipped --arms real-time --episodes 20 "
        "--seed 7000000",
        headline=_deployed,
    ),
    "deploy-expert": Quoted(
        "touchgoal benchmark deploy --tasks pick-place --policies scripted --arms environment lock-step "
        "--episodes 20 --seed 7000000",
    ),
    "deploy-in-a-row": Quoted("touchgoal benchmark deploy --policies shipped --in-a-row 20"),
    "policy-delay": Quoted("touchgoal benchmark policy-delay"),
    "policy-delay-causes": Quoted("touchgoal benchmark policy-delay --causes"),
    "maze-delay": Quoted("touchgoal benchmark policy-delay --task bead-maze --jitter 50"),
    "maze-delay-causes": Quoted("touchgoal benchmark policy-delay --task bead-maze --causes"),
    "sent-stream": Quoted("touchgoal benchmark sent-stream"),
    "replay": Quoted("touchgoal benchmark replay"),
    "maze": Quoted(
        "touchgoal run-policy --task bead-maze --env.split test --episodes 100 --seed 4000000 --no-video",
        headline=_successes,
    ),
    "maze-as-deployed": Quoted(
        "touchgoal run-policy --task bead-maze --env.split test --env.as-deployed --env.start-angle 10 "
        "--episodes 100 --seed 4000000 --no-video",
        "the shipped policy leads a bead along wires it has not seen, by touch, as deployed",
        _successes,
    ),
    "bead-maze": Quoted("touchgoal benchmark bead-maze --held-out 40", headline=_maze),
    "bead-maze-encoders": Quoted(
        "touchgoal benchmark bead-maze --policies runs/maze-half-untrained/policy runs/maze-half-mae/policy "
        "runs/maze-half-dino/policy runs/maze-half-ijepa/policy runs/maze-half-vjepa/policy "
        "runs/maze-half-aligned/policy runs/maze-half-shipped/policy runs/maze-half-wrench/policy "
        "runs/maze-half-end-to-end/policy --held-out 0 --plan-ticks --no-shuffled",
    ),
    "bead-maze-seeds": Quoted(
        "touchgoal benchmark bead-maze --policies "
        + " ".join(
            f"runs/maze-all-{name}-{seed}/policy"
            for name in ("shipped", "wrench", "end-to-end")
            for seed in range(3)
        )
        + " --held-out 0 --plan-ticks --no-shuffled",
    ),
    "reward-quality": Quoted(
        "touchgoal benchmark reward-quality",
        "the last cost tells a success from a dropped object (area under ROC)",
        _auc,
    ),
    "tactile-realism": Quoted(
        "touchgoal benchmark tactile-realism",
        "simulated pictures of real presses that the fit has not seen",
        _realism,
    ),
    "tactile-speed": Quoted(
        "touchgoal benchmark tactile-speed",
        "tactile pictures of a ball, 240 x 320, all stages, one core",
        _median_rate("240x320 ball", "frames/s"),
    ),
    "env-speed": Quoted(
        "touchgoal benchmark env-speed",
        headline=_median_rate(
            "env step (50 physics steps), two tactile images, holding", "per second"
        ),
    ),
    "encoder-speed": Quoted("touchgoal benchmark encoder-speed"),
    "policy-latency": Quoted("touchgoal benchmark policy-latency", headline=_plan),
    "touch-probes": Quoted(
        "touchgoal benchmark touch-probes --real-balls mini_presses digit_presses"
    ),
    "tacbench": Quoted("touchgoal benchmark tacbench"),
    "tacbench-slides": Quoted(
        "touchgoal benchmark tacbench --tasks force slip pose grasp textile --shares 1 0.1 0.01 --encoders "
        "gelsight_mini_markers_mae runs/slides-mae/encoder runs/slides-dino/encoder runs/slides-ijepa/encoder "
        "runs/slides-vjepa/encoder random:runs/slides-dino/encoder"
    ),
    "tacbench-pose": Quoted(
        "touchgoal benchmark tacbench --tasks pose --slides 300 --steps 2000 --shares 1 --encoders "
        "gelsight_mini_markers_mae runs/slides-dino/encoder"
    ),
    "tacbench-end-to-end": Quoted(
        "touchgoal benchmark tacbench --tasks force slip pose --shares 0.1 0.01 --encoders "
        "gelsight_mini_markers_mae end-to-end:compact --end-to-end-steps 400"
    ),
    "faults": Quoted("touchgoal benchmark faults"),
}
