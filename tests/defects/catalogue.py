"""Deliberate defects: each is one substitution in one file, and the tests that must then fail."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Defect:
    """`old`, which stands in `file` exactly once, becomes `new`; one of `tests` (pytest's names) must fail at least."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, root: Path) -> str:
        """The file's text with the defect.

        Raises:
            ValueError: if `old` does not stand there exactly once.
        """
        text = (root / self.file).read_text()
        if (times := text.count(self.old)) != 1:
            raise ValueError(
                f"{self.name}: {self.file} holds {self.old!r} {times} times, not once: bring it up to date"
            )
        return text.replace(self.old, self.new)


FEATURES, NETWORK = "gns_pyg/graph/features.py", "gns_pyg/models/contact_network.py"
IMPULSES = "gns_pyg/models/impulse_network.py"
FLIGHT, INTEGRATOR = "gns_pyg/scene/free_flight.py", "gns_pyg/dynamics/integrator.py"
SIMULATOR, BOUNDARY = "gns_pyg/dynamics/simulator.py", "gns_pyg/dynamics/boundary.py"
TRAINING = "gns_pyg/training/module.py"

DEFECTS = [
    Defect(
        "epsilon dropped from the direction",
        FEATURES,
        "rel_pos / torch.maximum(distance, 1e-3 * radius)[:, None]",
        "rel_pos / distance[:, None]",
        ("tests/dynamics/test_simulator.py::test_gradients_of_coincident_grains_are_finite",),
    ),
    Defect(
        "epsilon dropped from the inverse distance",
        FEATURES,
        "return radius / torch.maximum(distance, 0.1 * radius)",
        "return radius / distance",
        ("tests/dynamics/test_simulator.py::test_gradients_of_coincident_grains_are_finite",),
    ),
    Defect(
        "epsilon dropped from the projection",
        "gns_pyg/dynamics/projection.py",
        "(depth / torch.maximum(distance, 1e-3 * touch))[:, None]",
        "(depth / distance)[:, None]",
        ("tests/fuzz/test_step.py::test_any_finite_state_gives_a_finite_step_or_an_error_of_ours",),
    ),
    Defect(
        "edge direction swapped in the features",
        FEATURES,
        "rel_pos = between(state.pos, sender, receiver)",
        "rel_pos = between(state.pos, receiver, sender)",
        ("tests/graph/test_features.py::test_a_grain_sees_another_one_where_it_is_and_as_it_moves",),
    ),
    Defect(
        "edge direction swapped in the network",
        NETWORK,
        "sender, receiver = edge_index\n",
        "receiver, sender = edge_index\n",
        ("tests/models/test_contact_network.py::test_edges_carry_from_sender_to_receiver",),
    ),
    Defect(
        "float32 positions: cast before the difference",
        FEATURES,
        "return values.index_select(0, sender) - values.index_select(0, receiver)",
        "low = values.float()\n    return (low.index_select(0, sender) - low.index_select(0, receiver)).double()",
        (
            "tests/graph/test_features.py::test_in_float32_a_thousand_kilometres_away_nothing_changes",
            "tests/dynamics/test_units.py::test_far_from_the_origin_in_float32",
        ),
    ),
    Defect(
        "float32 positions: cast before the difference to a wall",
        FEATURES,
        "rel_pos = walls.pos.index_select(0, point) - state.pos.index_select(0, grain)",
        "rel_pos = (walls.pos.float().index_select(0, point) - state.pos.float().index_select(0, grain)).double()",
        ("tests/dynamics/test_units.py::test_far_from_the_origin_in_float32",),
    ),
    Defect(
        "float32 gaps: cast before lengths are subtracted",
        FEATURES,
        "touch = state.radius[sender] + state.radius[receiver]\n",
        "rel_pos, touch = rel_pos.to(dtype), (state.radius[sender] + state.radius[receiver]).to(dtype)\n",
        ("tests/graph/test_features.py::test_a_gap_of_a_micrometre_is_exact_in_float32",),
    ),
    Defect(
        "missing size= where messages are summed",
        "gns_pyg/models/interaction.py",
        "self.propagate(ends.index, messages=messages, size=size)",
        "self.propagate(ends.index, messages=messages)",
        (
            "tests/models/test_contact_network.py::test_computing_all_grains_gives_what_computing_the_reached_ones_gives",
        ),
    ),
    Defect(
        "wrong sign of the wall's velocity, where it is placed",
        BOUNDARY,
        "time_s + self.dt_s)[0] - pos) / self.dt_s",
        "time_s + self.dt_s)[0] - pos) / -self.dt_s",
        ("tests/dynamics/test_free_grains.py::test_a_grain_over_a_floor",),
    ),
    Defect(
        "wrong sign of the wall's velocity, in the features",
        FEATURES,
        "rel_vel = walls.vel.index_select(0, point) - state.vel.index_select(0, grain)",
        "rel_vel = -walls.vel.index_select(0, point) - state.vel.index_select(0, grain)",
        ("tests/graph/test_features.py::test_a_grain_sees_a_wall_where_it_is_and_as_it_moves",),
    ),
    Defect(
        "moving walls stay where they were at the start",
        BOUNDARY,
        "walls.append(part.at(rows - graph * len(part.pos), state.time_s[graph]))",
        "walls.append(part.at(rows - graph * len(part.pos), 0 * state.time_s[graph]))",
        ("tests/dynamics/test_simulator.py::test_turning_walls_are_searched_where_they_are",),
    ),
    Defect(
        "wall normals flipped",
        "gns_pyg/scene/boundary_points.py",
        "side = -1.0 if mesh.is_watertight else 1.0",
        "side = 1.0 if mesh.is_watertight else -1.0",
        (
            "tests/scene/test_boundary_points.py::test_normals_are_unit_and_point_inwards",
            "tests/scene/test_boundary_points.py::test_normals_of_an_open_part_follow_its_winding",
        ),
    ),
    Defect(
        "off by one frame: velocities of the frame before",
        INTEGRATOR,
        "vel = window.vel[frame]",
        "vel = window.vel[frame - 1]",
        ("tests/dynamics/test_free_grains.py::test_passing_grains_step_by_step",),
    ),
    Defect(
        "off by one frame: the target of a training step",
        TRAINING,
        "following = self.simulator.integrator.read(window, frame + 1)",
        "following = self.simulator.integrator.read(window, frame)",
        ("tests/training/test_module.py::test_free_flight_leaves_nothing_to_learn",),
    ),
    Defect(
        "off by one frame: own steps in training do not count",
        TRAINING,
        "state, frame = self.simulator(state), frame + 1",
        "state, frame = self.simulator(state), frame",
        ("tests/training/test_module.py::test_free_flight_leaves_nothing_to_learn",),
    ),
    Defect(
        "a restart reads the frame after its own",
        "data_gen/continuation.py",
        "trajectory.read(name, frame, frame + 1)[0]",
        "trajectory.read(name, frame + 1, frame + 2)[0]",
        ("tests/data_gen/test_restart.py::TestWithoutYade::test_a_partial_state_holds_what_it_says",),
    ),
    Defect(
        "a feature not normalised: approach on edges",
        FEATURES,
        "return [gaps, approach / velocity_m_s,",
        "return [gaps, approach,",
        ("tests/graph/test_features.py::test_in_other_units_nothing_changes",),
    ),
    Defect(
        "a feature not normalised: grain velocity",
        SIMULATOR,
        "columns = [state.vel / self.statistics.velocity_m_s]",
        "columns = [state.vel]",
        ("tests/dynamics/test_units.py::test_other_units",),
    ),
    Defect(
        "neighbour cap 8",
        "gns_pyg/graph/neighbors.py",
        "        return edges[:, edges[0] != edges[1]]\n",
        "        edges = edges[:, edges[0] != edges[1]]\n"
        "        ends = edges[1].contiguous()\n"
        "        rank = torch.arange(len(ends)) - torch.searchsorted(ends, ends)\n"
        "        return edges[:, rank < 8]\n",
        ("tests/graph/test_neighbors.py::test_no_neighbour_is_dropped_in_a_crowd",),
    ),
    Defect(
        "noise left on in evaluation",
        "gns_pyg/evaluation/predict.py",
        "replace(simulator.integrator.read(window, before, steps), time_s=times_s), window",
        "perturbed(replace(simulator.integrator.read(window, before, steps), time_s=times_s), 1, 1e-5, 0), window",
        ("tests/evaluation/test_absence.py::test_an_untrained_model_is_exact_where_nothing_touches",),
    ),
    Defect(
        "no noise in training",
        TRAINING,
        "        state, counted = perturb(state, self.config, self.simulator, randoms)\n",
        "        counted = torch.ones_like(state.batch, dtype=torch.bool)\n",
        ("tests/training/test_module.py::test_noise_is_seen_in_the_loss",),
    ),
    Defect(
        "noise added to the stored frames",
        "gns_pyg/training/noise.py",
        "pos=state.pos + config.noise_radii * state.radius[:, None] * noise(state.pos),",
        "pos=state.pos.add_(config.noise_radii * state.radius[:, None] * noise(state.pos)),",
        ("tests/training/test_module.py::test_noise_is_added_to_a_copy",),
    ),
    Defect(
        "gravity twice",
        FLIGHT,
        "gravity = constant(scene.gravity_m_s2, pos)",
        "gravity = 2 * constant(scene.gravity_m_s2, pos)",
        ("tests/dynamics/test_integrator.py::test_damping_that_spares_gravity_leaves_plain_ballistics",),
    ),
    Defect(
        "damping left out of free flight",
        FLIGHT,
        "felt = torch.full_like(pos[:, :1], scene.damping)",
        "felt = torch.zeros_like(pos[:, :1])",
        ("tests/evaluation/test_baselines.py::test_ballistic_predictors_are_exact_in_free_flight",),
    ),
    Defect(
        "damping of the scene where the case has its own",
        INTEGRATOR,
        "if state.parameters is not None:",
        "if state.parameters is None:",
        ("tests/dynamics/test_integrator.py::test_every_graph_has_its_own_damping",),
    ),
    Defect(
        "statistics from test cases too",
        "gns_pyg/run.py",
        "statistics = measure(cases.train, ",
        "statistics = measure([*cases.train, *cases.test], ",
        ("tests/faults/test_honest.py::test_statistics_come_from_training_cases_alone",),
    ),
    Defect(
        "layer norm dropped in the fused path only",
        "gns_pyg/models/mlp.py",
        "return rows.mul_(length.square_().div_(rows.shape[1]).add_(norm.eps).rsqrt_())",
        "return rows",
        (
            "tests/models/test_contact_network.py::"
            "test_without_gradients_layers_see_the_same_numbers_of_rows_at_every_step",
        ),
    ),
    Defect(
        "nan turned to 0 in the fused path",
        "gns_pyg/models/mlp.py",
        "weight.to(cast), None if bias is None else bias.to(cast))",
        "weight.to(cast), None if bias is None else bias.to(cast)).nan_to_num(0.0)",
        ("tests/models/test_contact_network.py::test_what_is_not_finite_stays_so_without_gradients",),
    ),
    Defect(
        "spins mirrored like velocities",
        "gns_pyg/training/augment.py",
        "ang_vel=hand * torch.einsum",
        "ang_vel=torch.einsum",
        ("tests/training/test_augment.py::test_rolling_stays_rolling",),
    ),
    Defect(
        "spins of two grains in contact subtracted, not added",
        FEATURES,
        "turning = sum((arm.index_select(0, end) for end in ends[1:])",
        "turning = sum((-arm.index_select(0, end) for end in ends[1:])",
        ("tests/graph/test_features.py::test_a_grain_sees_another_one_where_it_is_and_as_it_moves",),
    ),
    Defect(
        "a contact's impulse given to both grains alike",
        IMPULSES,
        "pushed, turned = -differ,",
        "pushed, turned = torch.ones_like(differ),",
        ("tests/models/test_impulse_network.py::test_no_momentum_is_made_between_grains",),
    ),
    Defect(
        "the sender of an impulse turned the other way",
        IMPULSES,
        "self.aggregate(turn, piece.at, piece.turned)",
        "self.aggregate(turn, piece.at, piece.pushed)",
        ("tests/models/test_impulse_network.py::test_a_tangential_impulse_turns_both_grains_alike",),
    ),
    Defect(
        "only the last frame is remembered",
        "gns_pyg/dynamics/memory.py",
        "drift + (moved - drift) / memory",
        "moved",
        ("tests/dynamics/test_memory.py::test_what_is_read_is_what_steps_would_have_remembered",),
    ),
    Defect(
        "fast grains look at their memory too",
        "gns_pyg/dynamics/memory.py",
        "return share.square() * drift",
        "return drift",
        ("tests/dynamics/test_memory.py::test_fast_grains_go_as_without_a_memory_and_slow_ones_do_not",),
    ),
    Defect(
        "gaps should stay as they were",
        "gns_pyg/training/module.py",
        "gap_loss(ours - theirs,",
        "gap_loss(ours - before,",
        ("tests/training/test_module.py::test_free_flight_leaves_nothing_to_learn",),
    ),
    Defect(
        "gaps count whatever they would be had they stayed",
        "gns_pyg/training/loss.py",
        "wrong / (stayed + BARE * n)",
        "wrong / n",
        ("tests/training/test_loss.py::test_gaps_count_over_how_far_they_would_be_had_they_stayed",),
    ),
    Defect(
        "graphs of a batch see each other's walls",
        BOUNDARY,
        "row = state.batch[grain] * len(part.pos) + point",
        "row = 0 * state.batch[grain] * len(part.pos) + point",
        ("tests/dynamics/test_simulator.py::test_batch_equals_separate",),
    ),
]


def tests_of(defects: Iterable[Defect]) -> list[str]:
    """Every test that is named, once."""
    return list(dict.fromkeys(test for defect in defects for test in defect.tests))
