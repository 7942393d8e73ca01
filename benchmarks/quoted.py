"""Figures on record: the command of each, what it measures, and its figure in one line."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from touchgoal.policies.evaluation.success_rate import SuccessRate

Metrics = dict[str, Any]


@dataclass(frozen=True)
class Quoted:
    """One measurement.

    Attributes:
        topic: heading in docs/results.md.
        claim: what is measured.
        command: as a user types it.
        headline: one line from what the command wrote to metrics.json.
        in_readme: whether README's table shows it.
    """

    topic: str
    claim: str
    command: str
    headline: Callable[[Metrics], str]
    in_readme: bool = False


def _successes(metrics: Metrics) -> str:
    return str(SuccessRate(metrics["successes"], metrics["trials"]))


def _deployed(metrics: Metrics) -> str:
    rows = metrics["deployments"]
    arms = dict.fromkeys(row["arm"] for row in rows)
    rates = {arm: [row["success"] for row in rows if row["arm"] == arm] for arm in arms}
    return "; ".join(f"{arm} {SuccessRate(sum(r), len(r))}" for arm, r in rates.items())


def _fewest_and_most(metrics: Metrics) -> str:
    done = [
        SuccessRate(sum(t["success"] for t in r["trials"]), len(r["trials"]))
        for r in metrics["rows"]
    ]
    worst, best = (f(done, key=lambda rate: rate.successes) for f in (min, max))
    return f"{worst} (worst row) to {best} (best row)"


def _maze(*names: str) -> Callable[[Metrics], str]:
    """Success of rows of the closed loop, by their shortened names."""

    def headline(metrics: Metrics) -> str:
        found = []
        for short, name in (entry.split("=") for entry in names):
            [own] = [t for key, t in metrics["closed_loop"].items() if name in key]
            found.append(f"{short} {SuccessRate(sum(t['success'] for t in own), len(own))}")
        return "; ".join(found)

    return headline


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
    return f"{stage['median']:.1f} ms, 95th percentile {stage['p95']:.1f} ms"


def _encoder_speed(metrics: Metrics) -> str:
    row = metrics["rows"][0]
    return (
        f"{row['encoder']} {row['tick']:.1f} ms a frame, {row['batched']:.0f} frames/s in batches"
    )


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
    return f"{metrics['median_error']:.2f} N [{low:.2f}, {high:.2f}]"


def _markers(metrics: Metrics) -> str:
    return f"{metrics['near']:.1%} of {metrics['dots']}; {metrics['exchanged']} exchanged"


def _nearest(metrics: Metrics) -> str:
    rows = []
    for row in metrics["rows"]:
        low, high = row["nearest_interval"]
        name = row["encoder"].removeprefix("runs/").removesuffix("/encoder")
        rows.append(f"{name} {row['nearest']:.2f} [{low:.2f}, {high:.2f}]")
    return "; ".join(rows)


def _faults(metrics: Metrics) -> str:
    rows = metrics["rows"]
    rest = [row["rest"] for row in rows if row["rest"] == row["rest"]]  # NaN: nothing to stop
    whole = sum(row["episodes_whole"] for row in rows)
    return f"{whole} of {len(rows)} keep all episodes; at rest within {max(rest):.2f} s"


def _stream(metrics: Metrics) -> str:
    most = {k: max(row[k] for row in metrics["rows"]) for k in ("outside", "speed", "jerk")}
    return (
        f"{-1e3 * most['outside']:.1f} mm inside the box; {most['speed']:.0%} of the speed limit, "
        f"{most['jerk']:.0%} of the jerk limit"
    )


def _replay(metrics: Metrics) -> str:
    return f"{1e3 * max(row['tool'] for row in metrics['rows']):.2f} mm at most"


_TACBENCH = {  # task -> metric, unit
    "force": ("mae_mn", "mN"),
    "slip": ("f1", "F1"),
    "pose": ("accuracy", "accuracy"),
    "grasp": ("accuracy", "accuracy"),
    "textile": ("accuracy", "accuracy"),
}


def _tacbench(metrics: Metrics) -> str:
    """The first encoder's figures with most labels, on each task's first test set."""
    found = {}
    for row in metrics["rows"]:
        if row["task"] in _TACBENCH and row["encoder"] == metrics["rows"][0]["encoder"]:
            found.setdefault(row["task"], row)
    parts = []
    for task, row in found.items():
        metric, unit = _TACBENCH[task]
        low, high = row[f"{metric}_interval"]
        form = ".0f" if unit == "mN" else ".2f"
        parts.append(f"{task} {row[metric]:{form}} [{low:{form}}, {high:{form}}] {unit}")
    return "; ".join(parts)


_REAL, _POLICIES = "Real touch", "Policies, simulated"
_DEPLOYED, _PAPERS = "Deployment on the twin", "The papers' measurements, simulated"
_SPEED = "Simulation and speed, one core"
_VIDEOS = "touchgoal benchmark real-touch --data physiclear --encoders "

QUOTED = {
    "real-touch": Quoted(
        _REAL,
        "nearest other video of a touch is of the same object (chance 0.015)",
        _VIDEOS + "gelsight_mini_surfaces gelsight_mini random:gelsight_mini pixels efficientnet",
        _nearest,
        in_readme=True,
    ),
    "real-touch-adapted": Quoted(
        _REAL,
        "the same after `train-encoder adapt` on other objects' videos",
        _VIDEOS + "runs/adapted/encoder",
        _nearest,
    ),
    "real-touch-seeds": Quoted(
        _REAL,
        "the same, two more training seeds of `train-encoder surfaces`",
        _VIDEOS + "runs/surfaces-1/encoder runs/surfaces-2/encoder",
        _nearest,
    ),
    "real-touch-without-labels": Quoted(
        _REAL,
        "the same, encoders trained without labels",
        _VIDEOS
        + " ".join(
            f"runs/{name}/encoder"
            for name in (
                "mae-simulated mae-real mae-both dino-simulated dino-real dino-both "
                "ijepa-simulated ijepa-real vjepa-simulated vjepa-real"
            ).split()
        )
        + " random:runs/dino-simulated/encoder random:runs/vjepa-simulated/encoder",
        _nearest,
    ),
    "real-touch-without-labels-both": Quoted(
        _REAL,
        "the same, trained on simulated and real touch",
        _VIDEOS + "runs/ijepa-both/encoder runs/vjepa-both/encoder random:runs/vjepa-both/encoder",
        _nearest,
    ),
    "real-force": Quoted(
        _REAL,
        "median force error on grasped objects outside the calibration, 0.5 to 25 N",
        "touchgoal benchmark real-force --data franka_wedge_grasps "
        "--encoders gelsight_mini_surfaces pixels",
        _real_force,
        in_readme=True,
    ),
    "real-force-rectified": Quoted(
        _REAL,
        "the same with the gel rectified by its corners",
        "touchgoal benchmark real-force --data franka_wedge_grasps "
        "--encoders gelsight_mini_surfaces pixels --corners 44 66 458 110 56 440 460 382",
        _real_force,
    ),
    "real-markers": Quoted(
        _REAL,
        "gel dots within 1 px of another tracker's",
        "touchgoal benchmark real-markers --data mini_markers",
        _markers,
    ),
    "pick-place": Quoted(
        _POLICIES,
        "pick-and-place, shipped policy, unseen scenes",
        "touchgoal run-policy --episodes 100 --no-video",
        _successes,
        in_readme=True,
    ),
    "pick-place-as-deployed": Quoted(
        _POLICIES,
        "the same with a real arm's delays, lags, hand and force estimate",
        "touchgoal run-policy --episodes 100 --env.as-deployed --no-video",
        _successes,
        in_readme=True,
    ),
    "pick-place-expert": Quoted(
        _POLICIES,
        "the scripted expert, which knows the scene",
        "touchgoal run-policy --episodes 100 --policy expert",
        _successes,
    ),
    "maze": Quoted(
        _POLICIES,
        "bead maze, shipped policy, unseen wires",
        "touchgoal run-policy --task bead-maze --env.split test --episodes 100 --seed 4000000 "
        "--no-video",
        _successes,
    ),
    "maze-as-deployed": Quoted(
        _POLICIES,
        "the same as deployed, hand up to 10 degrees off the wire",
        "touchgoal run-policy --task bead-maze --env.split test --env.as-deployed "
        "--env.start-angle 10 --episodes 100 --seed 4000000 --no-video",
        _successes,
        in_readme=True,
    ),
    "maze-delay": Quoted(
        _POLICIES,
        "bead maze under delays of 0 to 150 ms, jitter 50 ms",
        "touchgoal benchmark policy-delay --task bead-maze --jitter 50",
        _fewest_and_most,
    ),
    "maze-delay-causes": Quoted(
        _POLICIES,
        "bead maze, each deployment effect alone and left out",
        "touchgoal benchmark policy-delay --task bead-maze --causes",
        _fewest_and_most,
    ),
    "deploy-pick-place": Quoted(
        _DEPLOYED,
        "pick-and-place, shipped policy",
        "touchgoal benchmark deploy --tasks pick-place --policies shipped --arms environment "
        "in-process lock-step --episodes 40 --seed 7000000",
        _deployed,
    ),
    "deploy-real-time": Quoted(
        _DEPLOYED,
        "pick-and-place over libfranka's protocol in real time, a fresh twin each",
        "touchgoal benchmark deploy --tasks pick-place --policies shipped --arms real-time "
        "--episodes 20 --seed 7000000",
        _deployed,
        in_readme=True,
    ),
    "deploy-expert": Quoted(
        _DEPLOYED,
        "pick-and-place, scripted expert",
        "touchgoal benchmark deploy --tasks pick-place --policies scripted --arms environment "
        "lock-step --episodes 20 --seed 7000000",
        _deployed,
    ),
    "deploy-bead-maze": Quoted(
        _DEPLOYED,
        "bead maze, shipped policy",
        "touchgoal benchmark deploy --tasks bead-maze --policies shipped --arms environment "
        "in-process lock-step --episodes 40 --seed 7000000",
        _deployed,
    ),
    "deploy-maze-real-time": Quoted(
        _DEPLOYED,
        "bead maze in real time",
        "touchgoal benchmark deploy --tasks bead-maze --policies shipped --arms real-time "
        "--episodes 20 --seed 7000000",
        _deployed,
    ),
    "faults": Quoted(
        _DEPLOYED, "faults survived ([each](faults.md))", "touchgoal benchmark faults", _faults
    ),
    "sent-stream": Quoted(
        _DEPLOYED,
        "an hour of wild commands through the safety layer",
        "touchgoal benchmark sent-stream",
        _stream,
    ),
    "replay": Quoted(
        _DEPLOYED,
        "same actions in environment and over the wire: distance of the tool",
        "touchgoal benchmark replay",
        _replay,
    ),
    "reward-quality": Quoted(
        _PAPERS,
        "last cost, success against a dropped object (AUC)",
        "touchgoal benchmark reward-quality",
        _auc,
        in_readme=True,
    ),
    "tacbench": Quoted(
        _PAPERS, "TacBench, shipped MAE, all labels", "touchgoal benchmark tacbench", _tacbench
    ),
    "tacbench-slides": Quoted(
        _PAPERS,
        "TacBench, objectives compared on slides",
        "touchgoal benchmark tacbench --tasks force slip pose grasp textile --shares 1 0.1 0.01 "
        "--encoders gelsight_mini_markers_mae runs/slides-mae/encoder runs/slides-dino/encoder "
        "runs/slides-ijepa/encoder runs/slides-vjepa/encoder random:runs/slides-dino/encoder",
        _tacbench,
    ),
    "tacbench-pose": Quoted(
        _PAPERS,
        "TacBench pose with five times the slides",
        "touchgoal benchmark tacbench --tasks pose --slides 300 --steps 2000 --shares 1 "
        "--encoders gelsight_mini_markers_mae runs/slides-dino/encoder",
        _tacbench,
    ),
    "tacbench-end-to-end": Quoted(
        _PAPERS,
        "TacBench at 1/10 of the labels, beside longer end-to-end training",
        "touchgoal benchmark tacbench --tasks force slip pose --shares 0.1 0.01 --encoders "
        "gelsight_mini_markers_mae end-to-end:compact --end-to-end-steps 400",
        _tacbench,
    ),
    "bead-maze-encoders": Quoted(
        _PAPERS,
        "bead maze on each frozen encoder, half the demonstrations, one seed",
        "touchgoal benchmark bead-maze --policies runs/maze-half-untrained/policy "
        "runs/maze-half-mae/policy runs/maze-half-dino/policy runs/maze-half-ijepa/policy "
        "runs/maze-half-vjepa/policy runs/maze-half-aligned/policy runs/maze-half-shipped/policy "
        "runs/maze-half-wrench/policy runs/maze-half-end-to-end/policy --held-out 0 --plan-ticks "
        "--no-shuffled",
        _maze("random weights=(untrained)", "MAE=(mae)", "end to end=end-to-end"),
    ),
    "bead-maze-seeds": Quoted(
        _PAPERS,
        "bead maze, all demonstrations, three training seeds",
        "touchgoal benchmark bead-maze --policies "
        + " ".join(
            f"runs/maze-all-{name}-{seed}/policy"
            for name in ("shipped", "wrench", "end-to-end")
            for seed in range(3)
        )
        + " --held-out 0 --plan-ticks --no-shuffled",
        _maze(
            "frozen embedding=not taught by wrenches",
            "wrench reading=mae), 130 demos, regression",
            "end to end=end-to-end",
        ),
    ),
    "tactile-realism": Quoted(
        _SPEED,
        "simulated images of held-out real presses, PSNR",
        "touchgoal benchmark tactile-realism",
        _realism,
        in_readme=True,
    ),
    "tactile-speed": Quoted(
        _SPEED,
        "tactile images of a ball, 240 x 320, all stages",
        "touchgoal benchmark tactile-speed",
        _median_rate("240x320 ball", "frames/s"),
    ),
    "env-speed": Quoted(
        _SPEED,
        "environment steps of 50 ms with two tactile images",
        "touchgoal benchmark env-speed",
        _median_rate("env step (50 physics steps), two tactile images, holding", "per second"),
    ),
    "encoder-speed": Quoted(
        _SPEED, "one touch embedding", "touchgoal benchmark encoder-speed", _encoder_speed
    ),
    "policy-latency": Quoted(
        _SPEED, "one plan of the bead maze's policy", "touchgoal benchmark policy-latency", _plan
    ),
}
