"""Failures made from the pictures of a success."""

import numpy as np
from toy_episodes import moving_blob

from touchgoal.control.features import FRONT, STATE, TACTILE
from touchgoal.episodes.outcomes.generate import MADE, made_failures
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.touches import contact_per_frame
from touchgoal.rewards.demonstration_costs import accepted_failures
from touchgoal.rewards.success import SuccessThreshold

LENGTH, CONTACT = 30, 12


def success(seed: int = 0, contact: int = CONTACT) -> Episode:
    """Untouched noise, then a blob that presses on both fingertips."""
    rng = np.random.default_rng(seed)
    touch = rng.normal(100, 1, (2, LENGTH, 48, 64, 3))
    touch[:, contact:, 10 + seed : 30 + seed, 20:40] += 40
    pictures = np.rint(touch).astype(np.uint8)
    frames = dict(zip(TACTILE, pictures, strict=True)) | {
        FRONT: moving_blob(LENGTH, 32, 48, seed),
        STATE: np.zeros((LENGTH, 15), np.float32),
    }
    meta = {"outcome": "success", "success": True, "seed": seed, "object": f"object {seed}"}
    return Episode(frames, "place it", meta)


def test_every_kind_changes_what_it_says() -> None:
    own, other = success(0), success(1)
    made = made_failures(own, other)
    assert set(made) == set(MADE)
    for name, failure in made.items():
        failure.check()
        assert STATE not in failure.frames and failure.meta["success"] is False
        assert failure.meta["outcome"] == f"made_{name}" and failure.meta["seed"] == 0
    touching = {n: contact_per_frame(f.frames[TACTILE[0]]) for n, f in made.items()}
    assert not touching["never_touch"].any() and not touching["freeze"].any()
    assert np.array_equal(made["never_touch"].frames[FRONT], own.frames[FRONT])
    assert touching["drop"][CONTACT] and not touching["drop"][-1]
    turn = (CONTACT + LENGTH) // 2
    back = made["rewind"].frames
    assert len(made["rewind"]) == 2 * turn and not touching["rewind"][-1]
    assert np.array_equal(back[FRONT][:turn], back[FRONT][::-1][:turn])
    firm, soft = (e.frames[TACTILE[1]][-1].astype(float) for e in (made["over_press"], own))
    assert firm.max() > soft.max() + 30
    wrong = made["wrong_object"].frames
    assert np.array_equal(wrong[TACTILE[0]], other.frames[TACTILE[0]])
    assert np.array_equal(wrong[FRONT], own.frames[FRONT])
    swapped = made["swapped_colours"].frames
    assert all(np.array_equal(v[..., ::-1], own.frames[k]) for k, v in swapped.items())


def test_a_threshold_is_tried_on_made_failures() -> None:
    """A cost that only sees the last touch rejects failures without touch, and accepts another object."""

    def last_cost(failure: Episode) -> float:
        side = failure.frames[TACTILE[0]].astype(float)
        return float(np.abs(side[-1] - side[0]).max() < 20)

    threshold = SuccessThreshold(0.5, "fused", 0.1, 9)
    passed = accepted_failures(threshold, [success(0), success(1)], last_cost)
    fails = dict.fromkeys(("never_touch", "freeze", "drop", "rewind"), (0, 2))
    passes = dict.fromkeys(("over_press", "wrong_object", "swapped_colours"), (2, 2))
    assert passed == fails | passes
    assert "wrong_object" not in accepted_failures(threshold, [success(0)], last_cost)
