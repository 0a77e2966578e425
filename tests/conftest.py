"""One thread: the tests' models are tiny, and threads that wait for each other on a busy machine only cost time."""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import torch

torch.set_num_threads(1)
