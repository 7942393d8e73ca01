"""Touch-use audit on made-up episodes whose touch is known to matter, or not to."""

from dataclasses import replace

import numpy as np

from benchmarks.papers.reward_quality.touch_audit import REPLACEMENTS, audit_touch
from touchgoal.rewards.curves import Contact, Curves
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.embedded import EmbeddedEpisode, EmbeddedGoal

RNG = np.random.default_rng(0)
NAMES = ("ball", "brick", "can")
FELT = np.eye(8)[: len(NAMES)]  # touch of each object
UNTOUCHED = np.eye(8)[-1]


def episode(k: int, success: bool = True, n: int = 80) -> EmbeddedEpisode:
    """Touches at half of its length, unless it fails; the camera sees a noisy way to the goal."""
    name, contact = k % len(NAMES), n // 2
    touch = np.tile(UNTOUCHED, (n, 2, 1))
    if success:
        touch[contact:] = FELT[name]
    touch += RNG.normal(0, 0.05, touch.shape)
    seen = np.stack([np.linspace(0, 1, n) + RNG.normal(0, 0.3, n), np.ones(n)], axis=1)
    return EmbeddedEpisode(
        {"image": seen.astype(np.float32), "touch": touch.astype(np.float32)},
        EmbeddingSource("offline", "front"),
        f"made up #{k}",
        20.0,
        ("left", "right"),
        Contact(contact if success else None, "truth"),
        object=NAMES[name],
        success=success,
    )


def goal(e: EmbeddedEpisode) -> EmbeddedGoal:
    touch = np.tile(FELT[NAMES.index(e.object)], (1, 2, 1)).astype(np.float32)
    return EmbeddedGoal({"touch": touch})


def measure(e: EmbeddedEpisode, to: EmbeddedGoal) -> Curves:
    image, touch = e.features["image"], e.features["touch"]
    touch_cost = 1 - (touch * to.features["touch"]).sum(-1).mean(1).astype(float)
    costs = {"fused": 0.5 * (1 - image[:, 0]) + 0.5 * touch_cost}
    return Curves(e.source, {}, e.fps, e.contact, costs, {})


def test_the_verdict_is_yes_where_touch_tells_and_no_where_it_was_shuffled() -> None:
    episodes = [episode(k, success=k % 4 != 3) for k in range(40)]
    goals = [goal(e) for e in episodes]
    audit = audit_touch(episodes, goals, measure)
    assert audit.mattered and audit.verdict.startswith("touch mattered: shuffled in time")
    assert "with another episode's touch the last cost is 0" in audit.verdict
    rows = {(r.metric, r.replacement): r for r in audit.rows}
    assert len(rows) == 4 * len(REPLACEMENTS)
    assert rows["last cost", "neutral"].low > 0.3 and rows["lag", "shifted"].low > 0
    assert rows["AUC", "neutral"].high < -0.1
    same = rows["last cost", "mirrored"]  # both fingertips feel the same here
    assert same.low <= 0 <= same.high
    touches = [e.features["touch"][RNG.permutation(len(e))] for e in episodes]
    pairs = zip(episodes, touches, strict=True)
    shuffled = [replace(e, features={**e.features, "touch": touch}) for e, touch in pairs]
    audit = audit_touch(shuffled, goals, measure)
    assert not audit.mattered and "no sign that touch mattered" in audit.table
