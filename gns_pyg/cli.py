"""The commands, as the top-level scripts and the installed gns-... programs run them."""

from gns_pyg import run
from gns_pyg.launch import launch


def train() -> None:
    """gns-train"""
    launch("train", run.train)


def rollout() -> None:
    """gns-rollout"""
    launch("rollout", run.rollout)


def evaluate() -> None:
    """gns-evaluate"""
    launch("evaluate", run.evaluate)


def stress() -> None:
    """gns-stress"""
    launch("stress", run.stress)
