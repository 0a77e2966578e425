"""Exchanged impulses: opposite and equal, turning with what they act on, gone where nothing is near."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from gns_pyg.errors import ConfigError
from gns_pyg.models.impulse_network import pieces
from gns_pyg.scene.free_flight import cundall
from gns_pyg.state import Contacts, Walls
from tests import scenes
from tests.simulators import IMPULSE, simulator, state_in_box

WALLS = {"shape": {"kind": "box", "size_m": [0.15, 0.15, 0.15], "center_m": [0.0, 0.0, 0.0]}, "points": 300}
STATES = ("full", "velocity", "differences")


def model(walls=False, radii=None, gravity=9.81, damping=0.0, **changes):
    boundary = {"walls": WALLS | {"friction_angle_rad": 0.5}} if walls else {}
    scene = scenes.scene(40, 5, boundary=boundary, damping=damping)
    scene = replace(scene, gravity_m_s2=[0.0, 0.0, -gravity])
    if radii:
        scene = replace(scene, grains=replace(scene.grains, radius_m=list(radii)))
    return simulator(scene, dtype=torch.float64, **(IMPULSE | changes))


@pytest.mark.parametrize("state", STATES)
def test_no_momentum_is_made_between_grains(state):
    network, start = model(state=state), state_in_box([25, 15], spin=state == "full")
    given = network.correction(start)[:, : 6 if state != "differences" else 3]
    assert given.abs().sum() > 1e-3
    for graph in range(2):
        assert torch.allclose(given[start.batch == graph].sum(0), torch.zeros(given.shape[1]).double(), atol=1e-12)


def test_unlike_masses_keep_their_momentum():
    network, start = model(radii=(0.01, 0.014)), state_in_box([40])
    start = replace(start, radius=torch.tensor([0.01, 0.014]).double().repeat_interleave(20))
    vel = network.correction(start)[:, 3:6]
    mass = start.radius[:, None] ** 3
    assert torch.allclose((mass * vel).sum(0), torch.zeros(3).double(), atol=1e-12 * float(mass.sum()))
    assert (vel.sum(0).abs() > 1e-4).any()


@pytest.mark.parametrize("walls", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("damping", [0.0, 0.2])
def test_what_is_turned_or_mirrored_comes_out_turned_or_mirrored(walls, mirrored, damping):
    """Where damping acts, along x, y and z one by one, only turns from axis to axis leave the law as it is."""
    network, start = model(walls, gravity=0.0, damping=damping), state_in_box([40])
    turns = [90, 180, -90] if damping else [17, 63, -115]
    q = torch.from_numpy(Rotation.from_euler("xyz", turns, degrees=True).as_matrix().round(0 if damping else 15))
    q, hand = (-q, -1.0) if mirrored else (q, 1.0)
    graph = network.graph(start)
    turned = replace(start, pos=start.pos @ q.T, vel=start.vel @ q.T, ang_vel=hand * start.ang_vel @ q.T)
    other = graph
    if graph.walls is not None:
        w = graph.walls
        other = replace(graph, walls=Walls(w.pos @ q.T, w.normal @ q.T, w.vel @ q.T, w.friction_angle))
    expected = network.effects(start, graph).view(-1, 3, 3) @ q.T
    expected[:, 2] *= hand
    assert torch.allclose(network.effects(turned, other).view(-1, 3, 3), expected, atol=1e-10)


def test_a_tangential_impulse_turns_both_grains_alike():
    """A single contact: whatever it gives, both spins change by the same, along the normal by nothing."""
    network, start = model(), state_in_box([40])
    two = start.pick(torch.tensor([0, 1]))
    two = replace(two, pos=torch.tensor([[0.0, 0.0, 0.0], [0.0192, 0.0, 0.0]]).double())
    given = network.correction(two)
    assert torch.allclose(given[0, :6], -given[1, :6])
    assert torch.allclose(given[0, 6:], given[1, 6:])
    assert given[0, 6:].abs().max() > 1e-4
    assert given[0, 6].abs() < 1e-12, "no twist about the normal"


@pytest.mark.parametrize("damping", [0.0, 0.2])
def test_grains_that_touch_nothing_get_exactly_zero(damping):
    network, start = model(walls=True, damping=damping, free_grains=False), state_in_box([40])
    far = replace(start, pos=torch.cat([start.pos[:-1] * 0.3, torch.tensor([[0.0, 0.0, 0.9]]).double()]))
    assert torch.equal(network.correction(far)[-1], torch.zeros(9).double())


def test_pieces_give_what_the_whole_gives(monkeypatch):
    network, start = model(walls=True), state_in_box([40])
    whole = network.correction(start)
    monkeypatch.setattr("gns_pyg.models.mlp.BLOCK", 16 * 7 // torch.get_num_threads())
    with torch.no_grad():
        assert torch.allclose(network.correction(start), whole, atol=1e-12)


@pytest.mark.parametrize("mutual", [True, False])
def test_what_contacts_see_and_give_are_each_others_gradient(mutual):
    """Against plain sums, filled up contacts and unlike masses too; twice differentiable."""
    random, n, e = torch.Generator().manual_seed(0), 6, 11
    ends, share = torch.randint(n, (2, e), generator=random), torch.rand(e, 2, generator=random).double()
    share = share if mutual else torch.ones_like(share)
    bare = Contacts(
        ends, torch.zeros(e, 1).double(), torch.zeros(e, 3, 2).double(), 0.1, share=share if mutual else None
    )
    (piece,) = pieces(bare, 16, n, mutual=mutual)
    grains, given = (torch.randn(m, 3, generator=random).double().requires_grad_() for m in (n, len(piece.at.begins)))
    sender, receiver = ends
    with torch.no_grad():
        seen = grains[sender] - grains[receiver] if mutual else -grains[receiver]
        assert torch.allclose(piece.at.to_contacts(grains, piece.differ)[:e], seen)
        got = torch.zeros_like(grains).index_add(0, receiver, share[:, 1:] * given[:e])
        if mutual:
            got = got.index_add(0, sender, -share[:, :1] * given[:e])
        assert torch.allclose(piece.at.to_grains(given, piece.pushed), got)
    for check in (torch.autograd.gradcheck, torch.autograd.gradgradcheck):
        check(lambda x: piece.at.to_contacts(x, piece.differ)[:e], grains)
        check(lambda x: piece.at.to_grains(x, piece.pushed), given)


def test_every_pair_is_there_once():
    network, start = model(), state_in_box([25, 15])
    sender, receiver = network.graph(start).grain_edges
    assert (sender < receiver).all()
    both = simulator(network.scene, dtype=torch.float64).graph(start).grain_edges
    assert both.shape[1] == 2 * len(sender)


@pytest.mark.parametrize("damping", [0.0, 0.2])
def test_gradients_are_finite_where_grains_coincide_and_stand_still(damping):
    network, start = model(walls=True, damping=damping), state_in_box([4])
    pos = torch.zeros(4, 3).double().requires_grad_()
    still = torch.zeros_like(start.vel)
    network.correction(replace(start, pos=pos, vel=still, ang_vel=still)).sum().backward()
    assert torch.isfinite(pos.grad).all()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)


@pytest.mark.parametrize("damping", [0.0, 0.2])
def test_every_parameter_is_used(damping):
    """Several processes that train together wait for the gradients of all."""
    network = model(walls=True, damping=damping)
    network.correction(state_in_box([40])).square().sum().backward()
    assert all(p.grad is not None for p in network.parameters())


@pytest.mark.parametrize(
    "changes", [{"absolute_position": True}, {"self_loops": True}, {"channels": 2}, {"skip": False}]
)
def test_what_an_impulse_network_cannot_be_is_refused(changes):
    with pytest.raises(ConfigError, match=f"model.{next(iter(changes))}"):
        model(**changes)


def test_an_unknown_network_is_refused():
    with pytest.raises(ConfigError, match="message or impulse"):
        model(network="other")


def test_rounds_see_what_earlier_rounds_have_changed():
    """Three grains in a row: the last is moved by the first only where there are two rounds."""
    row = torch.tensor([[0.0, 0.0, 0.0], [0.0195, 0.0, 0.0], [0.039, 0.0, 0.0]]).double()
    for layers, reached in ((1, False), (2, True)):
        network, start = model(layers=layers, free_grains=False), replace(state_in_box([3]), pos=row)
        faster = replace(start, vel=start.vel + torch.tensor([[1.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3]).double())
        moved = (network.correction(faster) - network.correction(start))[2].abs().max() > 1e-12
        assert bool(moved) == reached


def with_shares(network, share, felt=0.0):
    shares = torch.tensor([share] * 5 + [felt] * 3).double()
    network.damping.forward = lambda before, after, slow: shares.expand(len(after.latent), 8)
    return network


def damped_and_plain(state):
    """The same networks with and without damping to learn."""
    damped, plain = (model(walls=True, damping=0.2, state=state, **row) for row in ({}, {"damped": False}))
    plain.load_state_dict({name: w for name, w in damped.state_dict().items() if not name.startswith("damping")})
    return damped, plain


@pytest.mark.parametrize("state", STATES)
def test_damping_takes_nothing_or_all(state):
    """Shares of 1: no grain that something reaches moves any more; of 0: as if there were no damping to learn."""
    start = state_in_box([40], spin=state == "full")
    damped, plain = damped_and_plain(state)
    assert torch.allclose(with_shares(damped, 0.0).correction(start), plain.correction(start), atol=1e-14)
    graph = damped.graph(start)
    reached = torch.cat([*graph.grain_edges, graph.wall_edges[1]]).unique()
    after = damped.integrator.integrate(start, with_shares(damped, 1.0).correction(start) * damped.scale)
    assert torch.allclose(after.pos[reached], start.pos[reached], atol=1e-12)
    assert after.vel[reached].abs().max() < 1e-12
    assert after.ang_vel is None or after.ang_vel[reached].abs().max() < 1e-10


def test_what_contacts_give_is_damped_along_x_y_and_z():
    """As one steady force beside gravity (`cundall`), where the learned factor is 1."""
    start, (damped, plain) = state_in_box([40]), damped_and_plain("full")
    ends = [
        m.integrator.integrate(start, m.correction(start) * m.scale).vel for m in (with_shares(damped, 0, 1), plain)
    ]
    gravity, damping = torch.tensor([0, 0, -9.81]).double() * plain.scene.frame_dt_s, torch.full((40, 1), 0.2).double()
    given = ends[1] - plain.integrator.without_contact(start).vel
    touched = (given.abs().sum(1) > 0)[:, None]
    expected = start.vel + gravity + given + cundall(start.vel, gravity + given, damping)
    assert touched.any()
    assert not torch.allclose(*ends)
    assert torch.allclose(torch.where(touched, ends[0], 0.0), torch.where(touched, expected, 0.0), atol=1e-12)
