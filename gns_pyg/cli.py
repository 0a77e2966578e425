"""The commands, as the top-level scripts and the installed gns-... programs run them."""

import sys

from gns_pyg.config import CONF
from gns_pyg.launch import launch
from gns_pyg.machine import brief_waits

with brief_waits():
    from gns_pyg import run
    from gns_pyg.tradeoff import app
    from gns_pyg.tradeoff.recommend import recommend


def train() -> None:
    """gns-train"""
    launch("train", run.train)


def rollout() -> None:
    """gns-rollout"""
    launch("rollout", run.rollout)


def evaluate() -> None:
    """gns-evaluate"""
    launch("evaluate", run.evaluate)


def tradeoff() -> None:
    """gns-tradeoff"""
    configs = f"{CONF}/tradeoff"  # a folder of its own: here `experiment` is a plain key
    if "recommend" in sys.argv[1:2]:
        del sys.argv[1]
        launch("recommend", recommend, configs)
    else:
        launch("tradeoff", app.tradeoff, configs)


def stress() -> None:
    """gns-stress"""
    launch("stress", run.stress)
