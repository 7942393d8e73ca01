"""Attentive probing (Sparsh's appendix C.1, after V-JEPA): a learned query attends to tokens.

One block of cross-attention, then two linear layers. With tokens of width 768, twelve heads and a
width of 768 the block has 7,088,640 parameters, as published.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

_WIDTH, _HEADS = 128, 4  # of a probe's pooler


class AttentivePooler(nn.Module):
    """Pooling of tokens to one vector by a learned query and an MLP, both with residuals."""

    def __init__(self, features: int, width: int, heads: int) -> None:
        """Build a randomly initialised block; `heads` divides the width of query and output."""
        super().__init__()
        self.heads = heads
        self.query = nn.Parameter(torch.zeros(1, 1, width))
        self.norm1 = nn.LayerNorm(features)
        self.q = nn.Linear(width, width)
        self.kv = nn.Linear(features, 2 * width)
        self.proj = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.mlp_in = nn.Linear(width, 4 * width)
        self.mlp_out = nn.Linear(4 * width, width)
        for linear in (self.q, self.kv, self.proj, self.mlp_in, self.mlp_out):
            nn.init.trunc_normal_(linear.weight, std=0.02)
            nn.init.zeros_(linear.bias)
        nn.init.trunc_normal_(self.query, std=0.02)

    def forward(self, tokens: Float[Tensor, "b t f"]) -> Float[Tensor, "b d"]:
        """Return the pooled vector."""
        # With a single query the key projection moves to the query, and the value projection is applied once, to the
        # weighted sum of tokens. The keys' bias adds the same to all tokens, so it drops out of the softmax.
        tokens = self.norm1(tokens)
        key, value = self.kv.weight.view(2, self.heads, -1, tokens.shape[2])
        q = self.q(self.query).view(self.heads, -1)
        asked = torch.einsum("hd,hdf->fh", q, key) / math.sqrt(q.shape[1])
        weights = (tokens @ asked).softmax(1)
        attended = torch.einsum("bhf,hdf->bhd", weights.transpose(1, 2) @ tokens, value)
        pooled = (
            self.query
            + self.proj(attended.flatten(1) + self.kv.bias[self.proj.in_features :])[:, None]
        )
        pooled = pooled + self.mlp_out(F.gelu(self.mlp_in(self.norm2(pooled))))
        return pooled[:, 0]


class AttentiveProbe(nn.Module):
    """Probe of an attentive pooler and a hidden layer of a quarter of its width, as published."""

    def __init__(self, features: int, outputs: int) -> None:
        super().__init__()
        self.pooler = AttentivePooler(features, _WIDTH, _HEADS)
        self.hidden = nn.Linear(_WIDTH, _WIDTH // 4)
        self.out = nn.Linear(_WIDTH // 4, outputs)

    def forward(self, tokens: Float[Tensor, "b t f"]) -> Float[Tensor, "b k"]:
        """Return the outputs, unbounded."""
        return self.out(F.relu(self.hidden(self.pooler(tokens))))
