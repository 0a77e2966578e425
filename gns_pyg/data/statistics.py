"""Scales of the training cases."""

from collections.abc import Sequence

import numpy as np
import torch

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import parameters, read_window
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.models.statistics import Statistics

FRAMES_PER_CASE = 50


def measure(trajectories: Sequence[Trajectory], integrator: Integrator) -> Statistics:
    """Root mean squares over frames spread evenly over the training cases (see `Statistics`)."""
    velocity, spin, position, corrections = [], [], [], []
    for trajectory in trajectories:
        last = trajectory.n_frames - 3
        for start in np.unique(np.linspace(0, max(last, 0), FRAMES_PER_CASE).astype(int)):
            window = read_window(trajectory, int(start), 3)
            grains = torch.from_numpy(trajectory.active(int(start) + 1, int(start) + 3).all(axis=0))
            if not grains.any():
                continue
            state, following = (integrator.read(window, frame).pick(grains) for frame in (1, 2))
            velocity.append(state.vel.square().mean())
            spin.append(window.ang_vel[1, grains].square().mean())
            position.append(state.pos)
            groups = integrator.target(state, following).split(3, dim=1)
            corrections.append(torch.stack([group.square().mean() for group in groups]))
    everywhere = torch.cat(position)
    mean, std = scales_of_parameters(trajectories)
    return Statistics(
        velocity_m_s=_root(velocity),
        spin_rad_s=max(_root(spin), 1e-12),
        radius_m=float(max(trajectory.radius.max() for trajectory in trajectories)),
        correction=torch.stack(corrections).mean(0).sqrt().tolist(),
        position_mean_m=everywhere.mean(0).tolist(),
        position_std_m=float((everywhere - everywhere.mean(0)).square().mean().sqrt()),
        parameters_mean=mean,
        parameters_std=std,
    )


def scales_of_parameters(trajectories: Sequence[Trajectory]) -> tuple[list[float], list[float]]:
    """Mean and standard deviation, over cases, of the values of `scene.PARAMETERS`; 1 where one does not vary."""
    values = np.array([parameters(trajectory) for trajectory in trajectories])
    mean, std = values.mean(axis=0), values.std(axis=0)
    return mean.tolist(), np.where(std > 1e-9 * np.abs(mean), std, 1.0).tolist()


def _root(squares: list[torch.Tensor]) -> float:
    return float(torch.stack(squares).mean().sqrt())
