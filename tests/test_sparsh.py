"""The vision transformer's options, and the published Sparsh encoders on it."""

from dataclasses import replace

import pytest
import torch

from touchgoal.encoders.backbones.sparsh import SPARSH_BASE
from touchgoal.encoders.backbones.vit import ViT, ViTConfig, sinusoidal_positions
from touchgoal.runtime.errors import UserError

TOY = ViTConfig((32, 48), width=48, depth=2, heads=2, mlp_ratio=2.0)


@pytest.mark.parametrize(
    ("method", "parameters"),
    [("mae", 86_254_848), ("dino", 86_255_616), ("ijepa", 86_386_944), ("vjepa", 86_537_472)],
)
def test_the_published_models_have_the_published_number_of_parameters(
    method: str, parameters: int
) -> None:
    with torch.device("meta"):
        vit = ViT(SPARSH_BASE[method])
    assert sum(parameter.numel() for parameter in vit.parameters()) == parameters


def test_registers_are_seen_by_attention_and_left_out_of_the_output() -> None:
    vit = ViT(replace(TOY, registers=3, layer_scale=1.0, class_token=True))
    images = torch.randn(2, 3, 32, 48)
    before = vit(images)
    assert before.shape == (2, 1 + 6, 48)
    assert vit.registers is not None
    with torch.no_grad():
        vit.registers[:, 2] += 1
    assert not torch.allclose(vit(images), before)


def test_a_block_whose_branches_are_scaled_by_nothing_does_nothing() -> None:
    vit = ViT(replace(TOY, layer_scale=0.0))
    images = torch.randn(2, 3, 32, 48)
    torch.testing.assert_close(vit(images), vit.norm(vit.embed_patches(images)))


def test_clips_of_any_size_become_tubelets_time_by_time() -> None:
    vit = ViT(replace(TOY, tubelet=2, frames=4))
    clip = torch.randn(1, 3, 4, 32, 40)  # padded to 48
    assert vit(clip).shape == (1, 2 * 2 * 3, 48)
    assert vit(torch.randn(1, 3, 6, 16, 16)).shape == (1, 3, 48)
    changed = clip.clone()
    changed[:, :, 2:] = 0
    torch.testing.assert_close(vit.embed_patches(changed)[:, :6], vit.embed_patches(clip)[:, :6])
    codes = sinusoidal_positions(2, 3, 48, 2).view(2, 2, 3, 3, 16)  # last: time, row, column
    assert torch.equal(codes[1, 0, 0, 0], codes[0, 1, 0, 1])
    assert torch.equal(codes[1, 0, 0, 0], codes[0, 0, 1, 2])
    with pytest.raises(UserError, match=r"multiple of 2 frames, not \(1, 3, 3, 32, 40\)"):
        vit(clip[:, :, :3])


def test_learned_positions_start_as_the_fixed_ones_and_hold_for_one_size() -> None:
    fixed = ViT(TOY)
    learned = ViT(replace(TOY, learned_positions=True))
    learned.load_state_dict(fixed.state_dict(), strict=False)
    images = torch.randn(2, 3, 32, 48)
    assert torch.equal(learned(images), fixed(images))
    with pytest.raises(UserError, match=r"learned positions for \(2, 3\) patches, not \(3, 3\)"):
        learned(torch.randn(2, 3, 48, 48))
