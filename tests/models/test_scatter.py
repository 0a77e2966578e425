"""What scatters: drawn as widely as it says, equal and opposite, the same for the same state, and learned alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from gns_pyg.dynamics.captured import Captured
from gns_pyg.dynamics.execution import Execution
from gns_pyg.errors import ConfigError
from gns_pyg.evaluation.predict import perturbed
from gns_pyg.models.scatter import FLOOR, STEP, hashed, mixed, normals
from tests import scenes
from tests.simulators import IMPULSE, SCATTER, simulator, state_in_box

BOX = {"kind": "box", "size_m": [0.15, 0.15, 0.15], "center_m": [0.0, 0.0, 0.0]}
WALLS = {"walls": {"shape": BOX, "points": 300, "friction_angle_rad": 0.5}}


def model(boundary=WALLS, dtype=torch.float64, **changes):
    return simulator(scenes.scene(40, 5, boundary=boundary), dtype=dtype, **(SCATTER | changes))


def change(network, state):
    """Of end velocities by what is drawn, over the velocity scale."""
    found = network.correction(state, drawn=True) - network.correction(state)
    assert torch.equal(found[:, :3], torch.zeros_like(found[:, :3]))
    assert torch.equal(found[:, 6:], torch.zeros_like(found[:, 6:]))
    return found[:, 3:6] * network.scale[3:6] / network.statistics.velocity_m_s


def test_the_bits_are_those_of_splitmix64():
    """First numbers of the seeds 0 and 1234567, as in its authors' reference code."""
    for seed, expected in ((0, 0xE220A8397B1DCDAF), (1234567, 6457827717110365317)):
        assert int(mixed(torch.tensor([seed]) + STEP)) % 2**64 == expected


@pytest.mark.parametrize("keys", ["successive", "places"])
def test_numbers_are_standard_normal_and_know_nothing_of_each_other(keys):
    places = 0.1 + 1e-12 * torch.arange(150000).double().view(-1, 3)
    key = torch.arange(50000) if keys == "successive" else hashed(places)
    found = normals(key).numpy()
    for column in found.T:
        assert stats.kstest(column, "norm").pvalue > 1e-4
        assert abs(np.corrcoef(column[1:], column[:-1])[0, 1]) < 0.02
    assert np.abs(np.corrcoef(found.T) - np.eye(4)).max() < 0.02
    assert np.abs(np.corrcoef((found**2).T) - np.eye(4)).max() < 0.02


@pytest.mark.parametrize("radii", [(0.01,), (0.01, 0.014)])
def test_what_is_drawn_scatters_as_widely_as_is_said_and_keeps_momentum(radii):
    """Over states a few picometres apart, whose widths are the same."""
    network, state = model({}), state_in_box([40], half_m=0.04)
    if len(radii) > 1:
        grains = replace(network.scene.grains, radius_m=list(radii))
        network = simulator(replace(network.scene, grains=grains), dtype=torch.float64, **SCATTER)
        state = replace(state, radius=torch.tensor(radii).double().repeat_interleave(20))
    with torch.inference_mode():
        said, many = network.scattered(state)[1], perturbed(state, 1000, 1e-12, seed=0)
        drawn = change(network, many).view(1000, 40, 3)
    mass = state.radius[:, None] ** 3
    assert (mass * drawn).sum(1).abs().max() < 1e-12 * float((mass * drawn.abs()).sum(1).max())
    found = torch.einsum("kni,knj->nij", drawn, drawn) / len(drawn)
    size = said.diagonal(dim1=1, dim2=2).sum(1)
    assert ((found - said + FLOOR * torch.eye(3)).abs().amax((1, 2)) < 0.25 * size).all()
    assert float(found.sum() / said.sum()) == pytest.approx(1, abs=0.03)
    assert size.median() > 1e4 * FLOOR


def test_the_same_state_is_followed_by_the_same_state():
    network, state = model(), state_in_box([25, 15], half_m=0.05)
    assert change(network, state).abs().max() > 1e-3
    assert torch.equal(network(state).vel, network(state).vel)
    moved = replace(state, pos=state.pos + 1e-9)
    assert not torch.allclose(change(network, moved), change(network, state), atol=1e-3)


@pytest.mark.parametrize("how", ["tiles", "captured", "batch", "order"])
def test_what_is_drawn_is_of_the_state_alone(how):
    network, state = model(), state_in_box([120], half_m=0.07)
    with torch.inference_mode():
        expected = network(state)
        found, order = None, torch.randperm(120, generator=torch.Generator().manual_seed(0))
        if how == "tiles":
            network.execution = Execution(tile_grains=15)
            found = network(state)
        elif how == "captured":
            found = Captured(network)(state)
        elif how == "order":
            found = network(state.pick(order))
            expected = expected.pick(order)
        else:
            both = [torch.cat([getattr(state, name)] * 2) for name in ("pos", "vel", "ang_vel", "radius", "time_s")]
            pair = type(state)(*both, torch.arange(2).repeat_interleave(120))
            found = network(pair).pick(torch.arange(120, 240))
    torch.testing.assert_close(found.vel, expected.vel, rtol=0, atol=1e-10)


def test_nothing_scatters_where_nothing_moves():
    network, state = model({}), state_in_box([40], half_m=0.04)
    network = simulator(replace(network.scene, gravity_m_s2=[0.0] * 3), dtype=torch.float64, **SCATTER)
    for round_ in network.grain_network.rounds:
        for weights in round_.impulse_mlp[-1].parameters():
            torch.nn.init.zeros_(weights)
    still = replace(state, vel=torch.zeros_like(state.vel), ang_vel=torch.zeros_like(state.vel))
    assert torch.equal(change(network, still), torch.zeros(40, 3).double())
    assert change(network, replace(still, vel=still.vel + 0.1)).abs().max() > 0


def test_what_is_expected_is_what_the_model_says_without_scatter():
    network, plain, state = model(), model(scatter=False), state_in_box([40])
    missing, more = plain.load_state_dict(network.state_dict(), strict=False)
    assert not missing
    assert {key.split(".")[1] for key in more} == {"spread"}
    for field in ("pos", "vel", "ang_vel"):
        assert torch.equal(getattr(network.expected(state), field), getattr(plain(state), field))


@pytest.mark.parametrize(
    ("changes", "key"),
    [({"network": "message"}, r"model\.scatter"), ({"state": "differences"}, r"requires\.state")],
)
def test_where_nothing_can_scatter_it_is_refused(changes, key):
    with pytest.raises(ConfigError, match=key):
        model(**changes)
