"""What one step must do with any finite state: shapes stay, all is finite, gradients too."""

from collections import Counter
from dataclasses import replace

import torch

from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import GnsError
from gns_pyg.state import State

FIELDS = ("pos", "vel", "ang_vel")
FUSED = {torch.float32: 1e-3, torch.float64: 1e-9}  # how far the path without gradients may be off, of the largest


def check(simulator: Simulator, state: State, counts: Counter[str]) -> None:
    """Takes a step and its gradients; counts it as passed, or as refused where a GnsError says why."""
    try:
        _check(simulator, state)
    except GnsError as error:
        counts[f"refused: {type(error).__name__} {error.where}"] += 1
    else:
        counts["passed"] += 1


def _check(simulator: Simulator, state: State) -> None:
    leaves = {name: value.clone().requires_grad_() for name in FIELDS if (value := getattr(state, name)) is not None}
    weights = [weight for weight in simulator.parameters() if weight.requires_grad]
    after = simulator(replace(state, **leaves))
    objective = torch.zeros((), dtype=torch.float64)
    for name, before in leaves.items():
        value = getattr(after, name)
        assert value.shape == before.shape
        assert value.dtype == torch.float64
        assert torch.isfinite(value).all(), f"{name} of grain {_first(value)}"
        scale = max(float(value.detach().abs().max()), 1e-300) if value.numel() else 1.0
        objective = objective + (value / scale).square().sum()
    if objective.requires_grad:
        found = torch.autograd.grad(objective, [*leaves.values(), *weights], allow_unused=True)
        names = [*leaves, *[name for name, weight in simulator.named_parameters() if weight.requires_grad]]
        for name, gradient in zip(names, found, strict=True):
            assert gradient is None or torch.isfinite(gradient).all(), f"gradient of {name}"
    with torch.inference_mode():
        fused = simulator.correction(state)
    plain = simulator.correction(state).detach()
    if plain.numel():
        off, largest = float((fused - plain).abs().max()), float(plain.abs().max())
        assert off <= FUSED[plain.dtype] * largest, f"{off:g} apart from {largest:g} without gradients"


def _first(values: torch.Tensor) -> int:
    return int((~torch.isfinite(values).all(dim=1)).nonzero()[0])
