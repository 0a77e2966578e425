"""Several processes share an update's batch: what they learn is what one process learns from all of it."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import distributed, multiprocessing
from torch.nn.parallel import DistributedDataParallel

from gns_pyg import bundle
from gns_pyg.data.windows import UpdateSampler
from gns_pyg.errors import ConfigError
from gns_pyg.state import Window
from gns_pyg.training.config import TrainingConfig
from gns_pyg.training.module import TrainingModule
from tests import scenes
from tests.simulators import simulator
from tests.training.test_module import CONFIG

ROOT = Path(__file__).parents[2]
SIZES = [30, 7, 18, 3]  # windows of very different numbers of grains: a mean of means is not their mean


def window(graphs):
    parts = []
    for graph in graphs:
        random = torch.Generator().manual_seed(graph)
        pos = 0.2 * torch.rand(5, SIZES[graph], 3, generator=random, dtype=torch.float64)
        vel = torch.randn(5, SIZES[graph], 3, generator=random, dtype=torch.float64)
        radius = torch.full((SIZES[graph],), 0.01, dtype=torch.float64)
        zeros, batch = torch.zeros(1, 5, dtype=torch.float64), torch.zeros(SIZES[graph], dtype=torch.long)
        parts.append(Window(pos, vel, vel, radius, time_s=zeros[:, 0], batch=batch, parameters=zeros))
    return Window.collate(parts)


class Share(TrainingModule):
    """A training module outside of Lightning's trainer."""

    global_step = 40
    global_rank = 0

    def log(self, *_, **__):
        pass

    def forward(self, graphs):
        return self.training_step(window(graphs), 0)


def module(rank=0, region=None):
    torch.manual_seed(0)
    own = CONFIG | {
        "batch_size": 4,
        "unroll_from": 0.0,
        "unroll": 2,
        "region_grains": region,
        "average_decay": 0.0,
        "balance": 3.0,
    }
    made = Share(simulator(scenes.scene(30, 5)), TrainingConfig(**own))
    made.global_rank = rank
    return made


def share(rank, port, region, path):
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", rank=rank, world_size=2)
    trained = DistributedDataParallel(module(rank, region))
    trained(range(2 * rank, 2 * rank + 2)).backward()
    torch.save([parameter.grad for parameter in trained.parameters()], f"{path}/{rank}.pt")
    del trained  # a reducer that outlives the group joins the group's threads while it holds the lock they wait for
    distributed.destroy_process_group()


@pytest.mark.parametrize("region", [None, 5])
def test_gradients_of_two_processes_are_those_of_one_on_the_union(region, tmp_path):
    alone = module(region=region)
    alone(range(4)).backward()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    both = multiprocessing.spawn(share, (port, region, str(tmp_path)), nprocs=2, join=False, daemon=True)
    both.join(100)  # returns when the first ends
    assert both.join(100), "a process hangs"
    expected = [parameter.grad for parameter in alone.parameters()]
    assert max(float(gradient.abs().max()) for gradient in expected) > 1e-3
    for rank in range(2):
        found = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        for one, two in zip(expected, found, strict=True):
            torch.testing.assert_close(two, one, rtol=1e-4, atol=1e-6 * float(expected[0].abs().max()))


def test_training_on_two_processes_ends_with_the_weights_of_one(tmp_path):
    words = ["train.py", "experiment=hopper", "training.updates=6", "training.batch_size=2", "training.unroll_from=0"]
    words += ["data.test_fraction=0", "model.hidden=8", "model.layers=1", "training.lr_start=1e-3"]
    for name, devices in (("one", 1), ("two", 2)):
        line = [sys.executable, *words, f"trainer.devices={devices}", "device=cpu", f"hydra.run.dir={tmp_path / name}"]
        done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
    one, two = (bundle.load(tmp_path / name / "bundle").state_dict() for name in ("one", "two"))
    for key in one:
        torch.testing.assert_close(two[key], one[key], rtol=1e-3, atol=2e-5)


def test_every_process_takes_its_part_of_the_one_sequence():
    """9 items in batches of 4: epochs run on into each other, and no item is lost or doubled."""
    whole, *parts = (iter(UpdateSampler(9, 4, 0, 0, *part)) for part in ((0, 1), (0, 2), (1, 2)))
    batches = [next(whole) for _ in range(9)]
    assert batches == [next(parts[0]) + next(parts[1]) for _ in range(9)]
    assert sorted(item for batch in batches for item in batch) == sorted(4 * list(range(9)))
    with pytest.raises(ConfigError, match="training.batch_size"):
        UpdateSampler(9, 3, 0, 0, 0, 2)
