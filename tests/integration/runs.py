"""Runs of the entry points in process, at a tiny size."""

from hydra import compose, initialize_config_dir

from gns_pyg import run
from gns_pyg.config import CONF

TINY = [
    "model.hidden=8",
    "training.batch_size=1",
    "training.unroll=2",
    "callbacks.rollout_metrics=null",
    "start_s=1.15",
]


def config(folder, *overrides, name="train"):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose(name, [f"folder={folder}", *overrides])


def train(folder, *overrides):
    return run.train(config(folder, *TINY, *overrides))
