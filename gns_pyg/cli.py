"""The commands, as the top-level scripts and the installed gns-... programs run them."""

from gns_pyg import run
from gns_pyg.config import CONF
from gns_pyg.launch import launch
from gns_pyg.tradeoff import app


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
    launch("tradeoff", app.tradeoff, f"{CONF}/tradeoff")  # a folder of its own: here `experiment` is a plain key
