"""Shared by all tests: one thread, no network, small episodes recorded once."""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["LP_NUM_THREADS"] = "0"

import torch  # noqa: E402

torch.set_num_threads(1)
