"""Contact and force on real grasps with a load cell: calibrated on some things, judged on others."""

from typing import Any

import numpy as np

from touchgoal.benchmarks.real_cost import EmbeddedGrasp, cost_table, judge_cost
from touchgoal.benchmarks.real_touch_encoders import Embedder
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.picture_force import calibrate_force, shrunk, statistics
from touchgoal.encoders.probes.property_probe import interval
from touchgoal.episodes.importers.force_grasps import ForceGrasp
from touchgoal.runtime.progress import track

RANGE = 25.0
"""N, up to which forces are judged."""
_PRESSED = 0.5  # N
_FIRST = 5  # frames
_STEADY = 0.2  # N
_IMPOSSIBLE = 60.0  # N: a spike of the load cell, beyond what the hand can do


def judge_grasps(grasps: list[ForceGrasp], embedders: dict[str, Embedder]) -> dict[str, Any]:
    """Errors on things left out of the calibration, when contact is told, and each encoder's cost."""
    rows, forces, things, contact = [], [], [], []
    embedded: dict[str, list[EmbeddedGrasp]] = {name: [] for name in embedders}
    for grasp in track(grasps, "reading", "grasp"):
        frames = grasp.frames()
        force = grasp.force[: len(frames)]
        # A steady load cell is an open hand with its offset; else the hand is closing already.
        open_hand = float(np.ptp(force[:_FIRST])) < _STEADY
        if open_hand:
            force = force - np.median(force[:_FIRST])
        untouched = np.median(frames[: _FIRST if open_hand else 1], 0).astype(np.uint8)
        background = shrunk(untouched)
        small = [shrunk(frame).astype(np.uint8) for frame in frames]
        rows.append(np.stack([statistics(frame, background) for frame in small]))
        forces.append(force)
        things.append(np.full(len(force), grasp.object))
        detector = ContactDetector(Background(np.stack(small[:1])))
        felt = np.array([detector.update(frame) for frame in small])
        begins = int((force > _PRESSED).argmax()) if (force > _PRESSED).any() else None
        if open_hand and felt.any() and begins is not None:
            contact.append(int(felt.argmax()) - begins)
        firmest = int(np.where(force < _IMPOSSIBLE, force, 0).argmax())
        for name, embed in embedders.items():
            seen = embed(frames, untouched).astype(np.float64)
            start = begins if open_hand else None
            embedded[name].append(EmbeddedGrasp(grasp.trial, grasp.object, seen, firmest, start))
    every, force, thing = np.concatenate(rows), np.concatenate(forces), np.concatenate(things)
    judged = (force <= RANGE) & (force > -1)
    error = np.full(len(force), np.nan)
    for name in np.unique(thing):
        known = judged & (thing != name)
        reader = calibrate_force(every[known], force[known])
        own = thing == name
        error[own] = np.abs(reader.of_statistics(every[own]) - force[own])
    pressed = judged & (force > _PRESSED)
    return {
        "grasps": len(grasps),
        "things": len(np.unique(thing)),
        "median_error": float(np.median(error[pressed])),
        "median_error_interval": interval(
            error[pressed], thing[pressed], lambda v: float(np.median(v))
        ),
        "by_thing": {
            str(n): float(np.median(error[pressed & (thing == n)])) for n in np.unique(thing)
        },
        "contact_delay": contact,
        # Of things grasped once there is no other grasp to compare with.
        "cost": {n: judge_cost(seen) for n, seen in embedded.items()} if _again(grasps) else {},
    }


def _again(grasps: list[ForceGrasp]) -> bool:
    return len({grasp.object for grasp in grasps}) < len(grasps)


def force_table(result: dict[str, Any]) -> str:
    """As people read it."""
    low, high = result["median_error_interval"]
    delay = result["contact_delay"]
    things = ", ".join(f"{name} {error:.1f}" for name, error in result["by_thing"].items())
    lines = [
        f"{result['grasps']} grasps of {result['things']} things, each read by what the others calibrated:",
        f"force of {_PRESSED:g} to {RANGE:g} N off by {result['median_error']:.2f} N (median; 95 % over "
        f"things {low:.2f}-{high:.2f}), {100 * result['median_error'] / RANGE:.0f} % of the range",
        f"by thing, N: {things}",
    ]
    if delay:
        lines.append(
            f"contact is told {min(delay)} to {max(delay)} frames (median {np.median(delay):g}) after "
            f"{_PRESSED:g} N on the load cell, in {len(delay)} grasps that start open"
        )
    lines += ["\n" + cost_table(cost, name) for name, cost in result["cost"].items()]
    return "\n".join(lines)
