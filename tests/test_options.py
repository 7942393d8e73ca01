"""Options: ranges hold for whoever makes a Config, and commands refuse in one line."""

import dataclasses
import pickle
from typing import Any

import pytest

from touchgoal.runtime.option_types import OptionError
from touchgoal.sim_envs.config import BeadMazeConfig, EnvConfig, PickPlaceConfig


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (EnvConfig, {"control_hz": 0}, "control_hz must be greater than or equal to 1, not 0"),
        (EnvConfig, {"timestep": 0}, "timestep must be greater than 0, not 0"),
        (EnvConfig, {"max_seconds": -1}, "max_seconds must be greater than 0, not -1"),
        (EnvConfig, {"camera_size": (-6, 128)}, "camera_size must be greater than or equal to 16"),
        (EnvConfig, {"camera_size": (128, 1282)}, "camera_size must be less than or equal to 1280"),
        (EnvConfig, {"camera_size": (97, 96)}, "camera_size must be a multiple of 2"),
        (EnvConfig, {"control_hz": 60}, "control_hz is 60; it must divide 500"),
        (EnvConfig, {"timestep": 0.0015}, "timestep must divide 2 ms"),
        (EnvConfig, {"max_seconds": 0.01}, "max_seconds must be at least a tick of 1/20 s"),
        (EnvConfig, {"disturbance": 3.0}, "disturbance must be less than or equal to 0.1"),
        (PickPlaceConfig, {"distractors": 40}, "distractors must be less than or equal to 4"),
        (PickPlaceConfig, {"mass": (1e-9, 1e-9)}, "mass must be greater than or equal to 0.001"),
        (PickPlaceConfig, {"mass": (float("nan"),) * 2}, "mass must be a finite number, not nan"),
        (PickPlaceConfig, {"mass": (0.2, 0.1)}, "mass must go from less to more, not 0.2 to 0.1"),
        (PickPlaceConfig, {"tolerance": float("nan")}, "tolerance must be a finite number"),
        (PickPlaceConfig, {"grasp_force": (500, 500)}, "grasp_force must be less than or equal to"),
        (
            PickPlaceConfig,
            {"objects": ("teapot",)},
            "objects unknown object 'teapot'; choose from: glass",
        ),
        (BeadMazeConfig, {"wires": ("knot-1",)}, "wires unknown wire 'knot-1'"),
    ],
)
def test_a_value_out_of_range_is_one_line(
    config: type, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(OptionError, match=f"^{config.__name__}: {message}") as refused:
        config(**values)
    assert "\n" not in str(refused.value)


def test_a_config_is_a_plain_frozen_dataclass() -> None:
    config = PickPlaceConfig(mass=(1, 2), max_seconds=3)
    assert config.mass == (1.0, 2.0) and isinstance(config.max_seconds, float)
    assert pickle.loads(pickle.dumps(config)) == config and hash(config)
    assert dataclasses.replace(config, tolerance=0.1).mass == config.mass
    assert dataclasses.asdict(config)["randomization"]["gain"] == 0.047
    with pytest.raises(OptionError):
        dataclasses.replace(config, tolerance=-0.1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.tolerance = 1.0  # pyright: ignore[reportAttributeAccessIssue]


def test_named_wires_are_taken_in_turn() -> None:
    config = BeadMazeConfig(wires=("helix-1", "arc-2000009"))
    assert [w.name for w in config.chosen_wires(3)] == ["helix-1", "arc-2000009", "helix-1"]
    assert len(config.chosen_wires()) == 2
    assert len(BeadMazeConfig(n_wires=5).chosen_wires()) == 5
    assert len(BeadMazeConfig(split="validation").chosen_wires()) == 80  # all there are
