"""The figure of a record in one line, from what its command wrote to metrics.json."""

from collections import Counter
from typing import Any

from touchgoal.policies.evaluation.success_rate import SuccessRate

Metrics = dict[str, Any]


def successes(metrics: Metrics) -> str:
    """Success rate of run-policy."""
    return str(SuccessRate(metrics["successes"], metrics["trials"]))


def _rate(trials: list[Metrics]) -> SuccessRate:
    return SuccessRate(sum(trial["success"] for trial in trials), len(trials))


def deployed(metrics: Metrics) -> str:
    """Success rate by arm."""
    rows = metrics["deployments"]
    arms = dict.fromkeys(row["arm"] for row in rows)
    return "; ".join(f"{arm} {_rate([r for r in rows if r['arm'] == arm])}" for arm in arms)


def fewest_and_most(metrics: Metrics) -> str:
    """Success of the worst and the best row."""
    done = [_rate(row["trials"]) for row in metrics["rows"]]
    worst, best = (f(done, key=lambda rate: rate.successes) for f in (min, max))
    return f"worst {worst}, best {best}"


def looks(metrics: Metrics) -> str:
    """Shares of looks that are right, refused, and confident and wrong, over all changes."""
    rows = metrics["rows"]
    counts = {kind: sum(row[kind] for row in rows) for kind in ("right", "refused", "wrong")}
    total = sum(counts.values())
    return ", ".join(f"{kind} {n / total:.0%}" for kind, n in counts.items()) + f" of {total}"


def mended(metrics: Metrics) -> str:
    """Success that the policy called so, of every row; how often it gave up, or was falsely done."""
    rows, kinds = [], ("gave up", "falsely done")
    for row in metrics["rows"]:
        trials = [t | {"success": t["late"] is not None} for t in row["trials"]]
        failures = Counter(trial["failure"] for trial in trials)
        counts = [f", {failures[how]} {how}" for how in kinds if how in failures]
        rows.append(f"{row['what']} {_rate(trials)}{''.join(counts)}")
    return "; ".join(rows)


def audited(metrics: Metrics) -> str:
    """Success by task: unchanged, and the most with any change of touch."""
    tasks: dict[str, list[SuccessRate]] = {}
    for row in metrics["rows"]:
        tasks.setdefault(row["what"].split(", ")[0], []).append(_rate(row["trials"]))
    return "; ".join(
        f"{task} {whole}, changed {max(changed, key=lambda rate: rate.successes)}"
        for task, (whole, *changed) in tasks.items()
    )


def maze(metrics: Metrics, **names: str) -> str:
    """Success of closed-loop rows, by label and the row's name or a part that no other has."""
    found, rows = [], metrics["closed_loop"]
    for label, part in names.items():
        [own] = [part] if part in rows else [name for name in rows if part in name]
        found.append(f"{label} {_rate(rows[own])}")
    return "; ".join(found)


def inputs(metrics: Metrics) -> str:
    """Success by what the policy reads."""
    rows = metrics["closed_loop"].items()
    return "; ".join(f"{name} {_rate(trials)}" for name, trials in rows if "state" in name)


def reward_kinds(metrics: Metrics, scene: str) -> str:
    """Mean AUC of the last cost over the kinds of failure: fused, and the plain distance."""

    def figure(curve: str) -> str:
        found = metrics["scenes"][scene]["auc"]["mean of true kinds"][curve]
        return f"{found['value']:.2f} [{found['low']:.2f}, {found['high']:.2f}]"

    return f"{figure('fused')} fused, {figure('image+tactile')} plain distance"


def judged(metrics: Metrics) -> str:
    """Least precision over hands and fits, and the kind that is told worst."""
    name, row = min(metrics["rates"].items(), key=lambda r: r[1]["precision"])
    kind, worst = min(metrics["kinds"].items(), key=lambda r: r[1]["auc"])
    return f"precision {row['precision']:.2f} ({name}); AUC {worst['auc']:.2f} ({kind})"


def verdicts(metrics: Metrics) -> str:
    """Shares of true successes and of failures that a judge calls successes."""
    shares = []
    for success, kind in ((True, "successes"), (False, "failures")):
        told = [r["verdict"] for r in metrics["deployments"] if r["success"] is success]
        shares.append(f"of {kind} {SuccessRate(told.count('success'), len(told))}")
    return "; ".join(shares)


def imitated(metrics: Metrics) -> str:
    """Success of policies whose demonstrations were weighted by each reward, all seeds together."""
    found = {
        name: SuccessRate(int(sum(f["successes"] for f in seeds)), metrics["trials"] * len(seeds))
        for name, seeds in metrics["imitation"].items()
    }
    return "; ".join(f"{name} {rate}" for name, rate in found.items())


def grips_found(metrics: Metrics, trials: str) -> str:
    """Searches that end with a force that neither loses nor crushes the rod, by reward."""
    ends = {row: by_trials[trials] for row, by_trials in metrics["ends"].items()}
    return "; ".join(f"{k} {SuccessRate(v.count('safe'), len(v))}" for k, v in ends.items())


def learning_curves(metrics: Metrics) -> str:
    """Success at the first and the last evaluation and mean over all, all seeds together, by reward."""
    found = []
    for arm, curves in metrics["curves"].items():
        of = metrics["trials"] * len(curves)
        first, last = (SuccessRate(sum(c[k] for c in curves), of) for k in (0, -1))
        mean = sum(map(sum, curves)) / (of * len(curves[0]))
        found.append(f"{arm} {first} at first, {last} at last, throughout {mean:.2f}")
    return "; ".join(found)


def median_rate(metrics: Metrics, start: str, unit: str) -> str:
    """Range of the median rates of rows whose name begins with `start`."""
    rates = [row["median"] for row in metrics["rows"] if row["what"].startswith(start)]
    return f"{min(rates):,.0f} to {max(rates):,.0f} {unit}"


def large_sets(metrics: Metrics) -> str:
    """Seconds and memory to open a large set, and seconds to open many sets as one."""
    large, many = metrics["one"][0], metrics["many"][0]
    return f"{large['seconds']:.0f} s, {large['megabytes'] / 1000:.1f} GB; {many['seconds']:.0f} s"


def loaders(metrics: Metrics) -> str:
    """Rates of lerobot's loader, of a first epoch and of a whole training, in samples a second."""
    lerobot, _, first, _, whole = metrics["rates"].values()
    return f"lerobot {lerobot:.0f}; first epoch {first:.0f}; whole training {whole:,.0f} a second"


def plan(metrics: Metrics) -> str:
    """Time of a whole plan."""
    stage = next(s for s in metrics["stages"] if s["what"].startswith("a whole plan"))
    return f"{stage['median']:.1f} ms, 95th percentile {stage['p95']:.1f} ms"


def encoder_speed(metrics: Metrics) -> str:
    """Time and rate of the first encoder."""
    row = metrics["rows"][0]
    rates = f"{row['tick']:.1f} ms a frame, {row['batched']:.0f} frames/s in batches"
    return f"{row['encoder']} {rates}"


def spectrum(metrics: Metrics) -> str:
    """The band in which simulated touches are farthest from held-out real ones, by sensor."""
    off = {r["sensor"]: r["simulated_db"] for r in metrics["rows"] if r["touches"].endswith("out")}
    return "; ".join(f"{sensor} {max(decibel, key=abs):+.1f} dB" for sensor, decibel in off.items())


def realism(metrics: Metrics) -> str:
    """Median PSNR, beside Taxim's table."""

    def median(sensor: str, method: str) -> float:
        own = [r for r in metrics["rows"] if (r["sensor"], r["method"]) == (sensor, method)]
        return sorted(row["psnr_near"] for row in own)[len(own) // 2]

    ours, taxim = "ours, circles corrected", "taxim table, on our background"
    return "; ".join(
        f"{name} {median(sensor, ours):.1f} dB (Taxim's table {median(sensor, taxim):.1f})"
        for name, sensor in (("GelSight", "gelsight"), ("Mini", "gelsight_mini"))
    )


def real_force(metrics: Metrics) -> str:
    """Median force error with its interval, largest bias of an object, correlation by force goal."""
    low, high = metrics["median_error_interval"]
    bias = max(map(abs, metrics["bias"].values()))
    followed = [f"{row['force']:.2f}" for row in metrics["followed"]["gelsight_mini"].values()]
    return (
        f"{metrics['median_error']:.2f} N [{low:.2f}, {high:.2f}]; largest bias {bias:.1f} N; "
        f"cost follows force {', '.join(followed)}"
    )


def markers(metrics: Metrics) -> str:
    """Share of dots near the other tracker's."""
    return f"{metrics['near']:.1%} of {metrics['dots']} dots; {metrics['exchanged']} exchanged"


def slip(metrics: Metrics) -> str:
    """AUC of slip by the markers' motion in each window."""
    rows = [row for row in metrics["rows"] if row["features"] == "markers"]
    return "; ".join("{} {:.2f} [{:.2f}, {:.2f}]".format(r["window"], *r["crop"]) for r in rows)


def nearest(metrics: Metrics, only: str = "") -> str:
    """Nearest-video accuracy of every encoder, or of those with one of these words in their names."""
    rows = []
    for row in metrics["rows"]:
        low, high = row["nearest_interval"]
        name = row["encoder"].removeprefix("runs/").removesuffix("/encoder")
        if not only or any(word in name for word in only.split()):
            rows.append(f"{name} {row['nearest']:.2f} [{low:.2f}, {high:.2f}]")
    return "; ".join(rows)


def retrieved(metrics: Metrics, row: str = "") -> str:
    """Mean average precision from touch to text of a row or the first encoder, by split, beside chance."""
    parts = []
    for split in dict.fromkeys(r["split"] for r in metrics["rows"]):
        rows = [r for r in metrics["rows"] if r["split"] == split]
        chance = next(r for r in rows if r["row"] == "chance")["touch to text"][0]
        encoders = [r for r in rows if r["row"] not in ("chance", "raw pixels")]
        own = next(r for r in encoders if row in ("", r["row"]))
        figure = "{:.1f} [{:.1f}, {:.1f}]".format(*own["touch to text"])
        parts.append(f"{split} {figure} (chance {chance:.1f})")
    return "; ".join(parts)


def named(metrics: Metrics, split: str = "press", column: str = "probe", **inputs: str) -> str:
    """Accuracy of the linear probe, or another column, on what a split holds out, by label and input."""
    rows = {row["input"]: row for row in metrics["rows"] if row["split"] == split}
    figures = {label: rows[name][column] for label, name in inputs.items()}
    return "; ".join("{} {:.0f} % [{:.0f}, {:.0f}]".format(k, *v) for k, v in figures.items())


def named_by_sentences(metrics: Metrics) -> str:
    """Share of touches whose object is found by its sentences, by number of candidates; first encoder."""
    row = {key: value for key, value in metrics["rows"][0].items() if key != "encoder"}
    return "; ".join(
        f"of {k} {m:.0f} % [{low:.0f}, {high:.0f}]" for k, (m, low, high) in row.items()
    )


def captioned(metrics: Metrics, row: str) -> str:
    """Share of touches whose own sentence comes first, on seen and on unseen objects."""
    found = next(r for r in metrics["rows"] if r["row"] == row)
    return "; ".join(
        "{} {:.0f} % [{:.0f}, {:.0f}]".format(kind, *found[f"{kind} top-1"])
        for kind in ("seen", "unseen")
    )


def materials(metrics: Metrics) -> str:
    """Share of real objects whose material is found by its sentences, first encoder."""
    row = metrics["rows"][0]
    return "{:.0%} [{:.0%}, {:.0%}]".format(row["accuracy"], *row["interval"])


def properties(metrics: Metrics) -> str:
    """Share of real videos with the right rank, by property, beside the most frequent answer."""
    row, frequent = metrics["rows"][-1], [*metrics["most_frequent"], 0.0]
    named = zip(row["right"].items(), frequent, strict=True)
    return "; ".join(f"{k} {v:.2f}" + (f" ({most:.2f})" if most else "") for (k, v), most in named)


def scaling(metrics: Metrics) -> str:
    """Most episodes a second, the writer's ceiling, and the model's of a number of workers left out of it."""
    rates, left_out = metrics["rates"], str(metrics["predicted"])
    most, share = max(rates.values()), metrics["model"][left_out] / rates[left_out]
    ceiling = metrics["ceilings"]["writer"]
    return f"{most:.1f} at most, the writer alone {ceiling:.1f}; model {share:.2f} of measured"


def faults(metrics: Metrics) -> str:
    """Faults that lose no episode, and the longest time to rest."""
    rows = metrics["rows"]
    rest = [row["rest"] for row in rows if row["rest"] is not None]  # None: nothing to stop
    whole = sum(row["episodes_whole"] for row in rows)
    return f"{whole} of {len(rows)} keep all episodes; at rest within {max(rest):.2f} s"


_TACBENCH = {  # task -> metric, unit
    "force": ("mae_mn", "mN"),
    "slip": ("f1", "F1"),
    "pose": ("accuracy", "accuracy"),
    "grasp": ("accuracy", "accuracy"),
    "textile": ("accuracy", "accuracy"),
}


def tacbench(metrics: Metrics) -> str:
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
