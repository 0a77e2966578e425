"""One thread: the tests' models are tiny, and threads that wait for each other on a busy machine only cost time.

No deadlines: a test holds a contract, never a time.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("gns", deadline=None)
settings.load_profile("gns")
