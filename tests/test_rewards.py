"""Goals, embedding distances, the normalizer, curves, their metrics and reports, on made-up embeddings."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchgoal.control.features import TACTILE_LEFT, TACTILE_RIGHT
from touchgoal.rewards import metrics
from touchgoal.rewards.curves import Contact, Curves, potential_reward
from touchgoal.rewards.distance.cost import compute_curves, plain_distances
from touchgoal.rewards.distance.fit_normalizer import fit_normalizer, separating
from touchgoal.rewards.distance.normalizer import DistanceNormalizer, EmbeddingSource
from touchgoal.rewards.features.embedded import EmbeddedEpisode, EmbeddedGoal, take_rows
from touchgoal.rewards.goals import (
    EpisodeEnds,
    GoalImage,
    GripForce,
    Modality,
    OwnFrame,
    Sentence,
    assign_goals,
    parse_goal,
)
from touchgoal.rewards.metrics import EPS_FLOOR, largest_rebound, measure_curve, noise
from touchgoal.rewards.report.report import write_report
from touchgoal.runtime.errors import UserError

N, CONTACT = 40, 20
ALL: tuple[Modality, ...] = ("image", "tactile", "text")
MADE = EmbeddingSource("towers", "camera", "encoder", "sensor")

# Embeddings are directions in the plane, so that a distance is 1 - cos of an angle: at the start
# everything lies at 90 degrees, the goal image at 0, a held apple at 30, its sentence at 60.


def direction(degrees: Sequence[float] | Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    radians = np.radians(np.asarray(degrees))
    return np.stack([np.cos(radians), np.sin(radians)], axis=-1).astype(np.float32)


def embedded(name: str, touches: bool = True, jitter: float = 0.0) -> EmbeddedEpisode:
    rng = np.random.default_rng(len(name))
    held = np.arange(N) >= CONTACT if touches else np.zeros(N, bool)
    angles = np.where(held, 30.0, 90.0) + jitter * rng.normal(size=(2, N))
    return EmbeddedEpisode(
        source=name,
        fps=20.0,
        contact=Contact(CONTACT if touches else None, "truth"),
        made_with=MADE,
        features={
            "image": direction(np.linspace(90, 0, N) + jitter * rng.normal(size=N)),
            "touch": direction(angles.T),
        },
        sides=(TACTILE_LEFT, TACTILE_RIGHT),
        descriptions=direction([60.0]),
        object="apple",
        success=touches,
    )


fit_scene = partial(fit_normalizer, scene="simulated pick-place")


def with_touch(episode: EmbeddedEpisode, touch: np.ndarray, **changes: Any) -> EmbeddedEpisode:
    return replace(episode, features={**episode.features, "touch": touch}, **changes)


def goal_of(episode: EmbeddedEpisode, *names: str) -> EmbeddedGoal:
    forms = {str(name): f"episode:{episode.source}#0" for name in ALL}
    ends = {**take_rows(episode.features, slice(-1, None)), "text": episode.descriptions[:1]}
    return EmbeddedGoal({k: v for k, v in ends.items() if not names or k in names}, forms)


@pytest.mark.parametrize(
    ("text", "goal"),
    [
        ("last", OwnFrame()),
        ("frame:0", OwnFrame(0)),
        ("image:ends/cup.png", GoalImage(Path("ends/cup.png"))),
        ("episode:data/a#b#12", EpisodeEnds(Path("data/a#b"), 12)),
        ("text:hard, smooth: round", Sentence("hard, smooth: round")),
        ("force:3.5", GripForce(3.5)),
    ],
)
def test_goal_is_read_and_written_back(text: str, goal: object) -> None:
    assert parse_goal(text) == goal and str(goal) == text


@pytest.mark.parametrize("text", ["lst", "frame:-1", "image:", "episode:data", "force:hard"])
def test_unknown_goal_lists_the_forms(text: str) -> None:
    with pytest.raises(UserError, match="last, frame:K, image:PATH, episode:ROOT#K, bank:SET"):
        parse_goal(text)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("a ball that is not soft", "hardly notices 'not'"),
        ("Isn't it smooth?", "hardly notices 'isn't'"),
        ("a round thing|an object without texture", "hardly notices 'without'"),
        ("a hard, soft ball", "says both 'soft' and 'hard'"),
        ("Rough. It feels smooth.", "says both 'smooth' and 'rough'"),
        ("force:-3", "a force is above 0 N"),
    ],
)
def test_goals_that_mean_nothing_are_refused(text: str, cause: str) -> None:
    with pytest.raises(UserError, match=cause):
        parse_goal(text if text.startswith("force:") else f"text:{text}")


@pytest.mark.parametrize("text", ["a knotted cotton net", "a hard ball, notably smooth"])
def test_words_that_only_contain_a_negation_are_taken(text: str) -> None:
    assert parse_goal(f"text:{text}") == Sentence(text)


def test_each_modality_takes_the_first_goal_that_speaks_for_it() -> None:
    last, image, words = OwnFrame(), GoalImage(Path("a.png")), Sentence("soft")
    chosen = assign_goals([image, last, words], ALL)
    assert chosen == {"image": image, "tactile": last, "text": words}
    with pytest.raises(UserError, match="'image:a.png' is never used: 'last' before it"):
        assign_goals([last, image], ALL)
    with pytest.raises(UserError, match="offline image tower knows no words: give --towers"):
        assign_goals([last, words], ["image"])
    assert assign_goals([words], ["image"], image_words=True) == {"image": words}
    assert assign_goals([last, words], ALL, image_words=True)["text"] == words


def test_distances_by_hand() -> None:
    e = embedded("a")
    raw = plain_distances(e.features, goal_of(e).features, completed=False)
    assert raw["image"][[0, -1]] == pytest.approx([1, 0], abs=1e-6)
    assert raw["tactile"][[0, -1]] == pytest.approx([1 - np.cos(np.pi / 3), 0], abs=1e-6)
    assert raw["text"] == pytest.approx(np.full(N, 1 - np.cos(np.pi / 6)), abs=1e-6)
    touch = e.features["touch"].copy()
    touch[:, 1] = direction([90.0])
    one_hand = plain_distances({**e.features, "touch": touch}, goal_of(e).features, completed=False)
    assert one_hand["tactile"][-1] == pytest.approx((1 - np.cos(np.pi / 3)) / 2, abs=1e-6)


def test_equal_touches_are_at_distance_0_faint_ones_too() -> None:
    e = embedded("a")
    for strength in (1.0, 0.5, 0.0):  # whitened embeddings are short, and 0 without contact
        faint = with_touch(e, np.float32(strength) * e.features["touch"])
        tactile = compute_curves(faint, goal_of(faint), None).raw["tactile"]
        assert tactile[-1] == pytest.approx(0, abs=1e-6)
        assert tactile[0] == pytest.approx(strength**2 * (1 - np.cos(np.pi / 3)), abs=1e-6)


def test_scale_maps_the_usual_start_to_one_and_end_to_zero(tmp_path: Path) -> None:
    training = [embedded("a" * (k + 1), jitter=1.0) for k in range(4)]
    normalizer = fit_scene(training, ["image", "tactile"])
    new = embedded("new episode", jitter=1.0)
    curves = compute_curves(new, goal_of(training[0]), replace_text(normalizer))
    for name in ("image", "tactile", "image+tactile"):
        assert curves.costs[name][:3] == pytest.approx(np.ones(3), abs=0.1)
        assert curves.costs[name][-1] == pytest.approx(0, abs=0.1)
    normalizer.save(tmp_path / "normalizer.json")
    assert DistanceNormalizer.load(tmp_path / "normalizer.json") == normalizer
    assert [p.name for p in tmp_path.iterdir()] == ["normalizer.json"]
    (tmp_path / "normalizer.json").write_text('{"start": {}}')
    with pytest.raises(UserError, match="is no normalizer"):
        DistanceNormalizer.load(tmp_path / "normalizer.json")


def replace_text(normalizer: DistanceNormalizer) -> DistanceNormalizer:
    """Add an entry for text, which the drawn words cannot fit (their ends are alike)."""
    return replace(
        normalizer, start=normalizer.start | {"text": 1.0}, goal=normalizer.goal | {"text": 0.0}
    )


def test_touch_goals_are_ends_with_the_same_object() -> None:
    apple = embedded("apple")
    pear = with_touch(apple, -apple.features["touch"], object="pear")
    normalizer = fit_scene([apple, replace(apple), pear], ["tactile"])
    assert normalizer.goal["tactile"] == pytest.approx(0, abs=1e-6)
    with pytest.raises(UserError, match="nearer the goal in 0% of 2 pairs"):
        fit_scene([apple, replace(pear, object="apple")], ["tactile"])
    with pytest.raises(UserError, match="they must share an object"):
        fit_scene([apple, pear], ["tactile"])
    found, [why] = separating([apple, pear])
    assert found == ["image"] and "share an object" in why


def test_scale_refuses_what_would_mislead() -> None:
    good = embedded("good")
    lost = with_touch(good, direction([[90.0] * 2] * 20 + [[140.0] * 2] * 20))
    held = with_touch(good, direction([[90.0] * 2] * 20 + [[60.0] * 2] * 20))
    misses = [embedded("a" * k, touches=False, jitter=1.0) for k in range(1, 9)]
    other = replace(good, made_with=EmbeddingSource("z", "camera"))
    cases: list[tuple[list[EmbeddedEpisode], Modality, str]] = [
        ([held, held, lost], "text", "nearer the goal in 67% of 3 pairs"),
        ([replace(miss, success=True) for miss in misses], "tactile", "'tactile'"),
        ([good, misses[0]], "image", "a failed"),
        ([good, other], "image", "other encoders"),
    ]
    for episodes, modality, message in cases:
        with pytest.raises(UserError, match=message):
            fit_scene(episodes, [modality])
    normalizer = fit_scene([good, replace(good)], ["image"])
    with pytest.raises(UserError, match="it has no 'tactile', only image, image .same episode."):
        compute_curves(good, goal_of(good), replace(normalizer, unit={}))
    units = replace(normalizer, unit={"front": 0.1})
    curves = compute_curves(good, goal_of(good, "image", "touch"), units)
    assert curves.raw.keys() == {"image", "tactile"} and curves.normalised.keys() == {"image"}
    own_camera = replace(good, made_with=EmbeddingSource("towers", camera=""))
    image = goal_of(good, "image")
    assert compute_curves(own_camera, image, normalizer).normalised  # a plain video, vouched for


@pytest.mark.parametrize("what", ["towers", "camera", "encoder", "sensor"])
def test_a_normalizer_of_other_embeddings_is_refused(what: str) -> None:
    good = embedded("good")
    normalizer = replace_text(fit_scene([good, replace(good)], ["image", "tactile"]))
    other = replace(good, made_with=replace(MADE, **{what: "z"}))
    with pytest.raises(
        UserError, match=f"does not apply: .* its {what} is {getattr(MADE, what)}, not z"
    ):
        compute_curves(other, goal_of(good), normalizer)


def test_rewards_by_hand() -> None:
    cost = np.array([1.0, 0.4, 0.6, 0.0])
    curves = Curves("a", {}, 20.0, Contact(None, "no touch"), {"image": cost}, {})
    assert curves.rewards["image"] == pytest.approx([-1.0, -0.4, -0.6, 0.0])
    assert potential_reward(cost, 1.0) == pytest.approx([0.0, 0.6, -0.2, 0.6])
    # gamma * -0.4 + 1, gamma * -0.6 + 0.4, 0.6
    assert potential_reward(cost, 0.9) == pytest.approx([0.0, 0.64, -0.14, 0.6])


def test_a_cost_nearer_than_the_usual_end_is_below_zero() -> None:
    raw = {"image": np.array([1e-16 - 2e-16, 2.0]), "tactile": np.array([0.1, 0.3])}
    near = {"image": np.array([-0.4, 1.0]), "tactile": np.array([1.0, -0.2])}
    about = "a", {}, 20.0, Contact(None, "no touch"), raw
    plain, normalised = (Curves(*about, costs) for costs in ({}, near))
    assert plain.costs["image"].min() == 0  # what rounding left below
    assert normalised.costs["image"] == pytest.approx([-0.4, 1.0])
    assert normalised.costs["image+tactile"] == pytest.approx([0.3, 0.4])


def test_report_holds_the_curves(tmp_path: Path) -> None:
    fall = np.linspace(1, 0, 30)
    goal = {"image": "last", "tactile": "last"}
    raw = {"image": 0.3 * fall, "tactile": 0.5 * fall}
    normalised = {"image": fall, "tactile": fall**2}
    curves = Curves("a $ path$ #3", goal, 20.0, Contact(12, "truth"), raw, normalised)
    write_report(curves, tmp_path / "out", "ep3")
    rows = np.genfromtxt(tmp_path / "out" / "ep3.csv", delimiter=",", names=True, deletechars="")
    for column, expected in {
        "time_s": np.arange(30) / 20,
        "cost_image+tactile": (fall + fall**2) / 2,
        "cosine_distance_image": raw["image"],
        "reward_image": -fall,
        "potential_reward_image": potential_reward(fall, 1.0),
    }.items():
        assert rows[column] == pytest.approx(expected, abs=1e-6), column
    write_report(curves, tmp_path, "ep3")
    assert (tmp_path / "out/ep3.png").read_bytes() == (tmp_path / "ep3.png").read_bytes()


# Small integers make ties and plateaus common; halves keep every sum exact.
CURVES = st.lists(st.integers(-6, 6), min_size=3, max_size=24).map(
    lambda values: np.array(values) / 2
)
STEP = np.where(np.arange(100) < 50, 1.0, 0.0)


def test_the_rank_correlation_by_hand() -> None:
    x, y = np.array([1.0, 2.0, 2.0, 3.0]), np.array([1.0, 3.0, 2.0, 4.0])
    # Ranks centred: (-1.5, 0, 0, 1.5) and (-1.5, .5, -.5, 1.5): 4.5 / sqrt(4.5 * 5).
    assert metrics.spearman(x, y) == pytest.approx(0.9**0.5)


def test_peaks_by_hand() -> None:
    """A plateau is one peak, at its middle; ends are none; prominence is over the higher base."""
    d = np.array([3.0, 1.0, 2.0, 2.0, 2.0, 1.5, 2.5, 0.0, 0.2, 0.0, 3.0])
    assert [metrics.find_peaks(d, eps).tolist() for eps in (0.5, 1.0)] == [[3, 6], [6]]


@given(CURVES)
def test_largest_rebound_is_its_definition(d: np.ndarray) -> None:
    brute = max(d[j] - d[i] for i in range(len(d)) for j in range(i, len(d)))
    assert largest_rebound(d) == brute


def test_straight_line_by_hand() -> None:
    m = measure_curve(np.linspace(1, 0, 101), contact=40)
    # The median of 1, .99, .98, .97, .96 is .98; half of it is reached at 1 - t / 100 <= .49.
    assert m.start == pytest.approx(0.98) and m.end == 0
    assert (m.t_drop_10, m.t_drop_25, m.t_drop_50, m.contact_lag) == (12, 27, 51, 11)
    assert m.area == pytest.approx(0.5) and m.sigma == pytest.approx(0, abs=1e-12)


def test_noise_is_measured_before_contact_and_blind_to_a_slope() -> None:
    rng = np.random.default_rng(1)
    d = np.linspace(1, 0, 4000) + rng.normal(0, 0.01, 4000)
    d[2000:] += rng.normal(0, 0.5, 2000)
    assert noise(d, contact=2000) == pytest.approx(0.01, rel=0.05)
    assert noise(d, contact=3) > 0.02  # too few frames: the whole curve


def test_flat_window_makes_no_peak_of_rounding() -> None:
    d = STEP + 1e-6 * np.cos(np.arange(100))
    d[:50] = 1
    m = measure_curve(d, contact=50)
    assert (m.sigma, m.eps, m.peaks) == (0, EPS_FLOOR, 0)


@pytest.mark.parametrize("wiggle", [0.0, 1e-7])
def test_constant_curve_is_undefined_not_perfect(wiggle: float) -> None:
    m = measure_curve(0.7 + wiggle * np.sin(np.arange(60)), contact=None)
    assert (m.spearman, m.t_drop_10, m.t_drop_50) == (None,) * 3
    assert m.area == pytest.approx(0.7)
