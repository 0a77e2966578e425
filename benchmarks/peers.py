"""This network beside other graph network simulators, same graph, widths and weights: `python -m benchmarks.peers`.

Every system runs in a process of its own (`peer.py`), all on one processor core with one thread; they take turns round
by round. A figure is the median over rounds, a ratio the median of the rounds' ratios. Every round has fresh inputs and
weights, so that nothing can be kept from the round before. The training figure is forward and backward of the mean
square of the output, with the gradients of all weights. Before that the peer's weights are copied into ours, and
outputs and gradients compared. Writes benchmarks/results/peers.json.

The graph is 1.5 s into a real drum run ($GNS_DATA/drum/case_000.h5, see docs/data_format.md), or a random packing of
the same size if there is none. The peers are not part of this project. They need a Python that has them:

    python3 -m venv peers && peers/bin/pip install torch torch_geometric jax dm-haiku jraph e3nn-jax==0.20.3 cloudpickle
    git clone https://github.com/geoelements/gns peers/geoelements
    git clone https://github.com/tumaer/lagrangebench peers/LagrangeBench
    python -m benchmarks.peers --peers peers

A peer that is absent is left out, and says so. Quick: `--rounds 3`. Where other programs run, choose a quiet `--core`,
and read the figures of processor time.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.peer import HIDDEN, LINEAR_LAYERS, ROUNDS_OF_MESSAGES
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.machine import has_bfloat16, processor
from gns_pyg.models.contact_network import ContactNetwork

OURS, KINDS = "gns_pyg", ("forward", "forward_backward")
ROUNDED = ", bfloat16"  # a system again, in fewer bits: its outputs are compared with its own in float32
TOLERANCE, OF_ROUNDED = 1e-4, 2e-2
HERE = "gns_pyg/models"
SYSTEMS = {  # system -> its package
    OURS: HERE,
    OURS + ROUNDED: HERE,
    "geoelements": "gns",
    f"geoelements{ROUNDED}": "gns",
    "LagrangeBench": "lagrangebench",
}
NOT_HERE = {"PhysicsNeMo": "sums messages after their residual, another function; needs Warp, s3fs, torchvision"}
N_NODES, N_PAIRS, TIME_S = 2530, 13035, 1.5
CASE = Path(os.environ.get("GNS_DATA", "data")) / "drum" / "case_000.h5"
ROOT = Path(__file__).parents[1]
OUT = Path(__file__).parent / "results" / "peers.json"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--peers", type=Path, default=Path("peers"), help="folder of the peers and their Python")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    os.sched_setaffinity(0, {options.core})
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    os.environ["JAX_PLATFORMS"] = "cpu"
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        arrays, source = graph()
        np.savez(Path(folder) / "graph.npz", **arrays)
        systems, left_out = {}, dict(NOT_HERE)
        for name, package in SYSTEMS.items():
            if name.endswith(ROUNDED) and not has_bfloat16():
                left_out[name] = "the processor does not multiply bfloat16"
                continue
            ours = package == HERE
            program = ROOT if ours else options.peers / name.removesuffix(ROUNDED)
            system = System(name, program, package, options.peers, Path(folder))
            if system.absent and ours:
                raise SystemExit(f"{name}: {system.absent}")
            if system.absent:
                left_out[name] = system.absent
                print(f"{name} left out: {system.absent}", flush=True)
            else:
                systems[name] = system
        outputs = {name: Path(folder) / f"{name}.npz" for name in systems}
        checks = {}
        for name in systems:
            if name.endswith(ROUNDED):
                files = (outputs[name], outputs[name.removesuffix(ROUNDED)])
                rounded, exact = (torch.from_numpy(np.load(file)["output"]) for file in files)
                off = error([rounded], [exact])
                checks[name] = {"checked": off < OF_ROUNDED, "output_error": float(f"{off:.1e}")}
            elif SYSTEMS[name] != HERE:
                checks[name] = checked(arrays, outputs[name])
        seconds = timed(systems, options.rounds)
    results = summary(systems, checks, seconds)
    about: dict[str, Any] = {
        "machine": processor(),
        "graph": {"nodes": N_NODES, "edges": 2 * N_PAIRS, "source": source},
    }
    about |= {"width": HIDDEN, "rounds_of_messages": ROUNDS_OF_MESSAGES, "linear_layers": LINEAR_LAYERS}
    results = {**about, "rounds": options.rounds, "left_out": left_out, **results}
    options.out.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results))


def graph() -> tuple[dict[str, Any], str]:
    """Node and edge features, senders and receivers (by receiver, then by sender): the nearest pairs, both ways,
    every node in one of them."""
    if CASE.is_file():
        case, source = Trajectory(CASE), f"drum, {TIME_S} s"
        frame = int(np.searchsorted(case.times_s, TIME_S - 1e-9))
        pos, *motion = (case.read(field, frame, frame + 1)[0] for field in ("position", "velocity", "angular_velocity"))
    else:
        random, source = np.random.default_rng(0), "random packing"
        pos, *motion = random.random((N_NODES, 3)), *random.standard_normal((2, N_NODES, 3))
    distance, neighbor = (found[:, 1:] for found in cKDTree(pos).query(pos, 64))
    pairs = np.sort([np.repeat(np.arange(N_NODES), 63), neighbor.ravel()], axis=0)
    rank = distance.copy()
    rank[:, 0] = 0  # every node's nearest first, so that all are reached
    by_rank = np.argsort(rank, axis=None)
    first = by_rank[np.sort(np.unique(pairs[:, by_rank], axis=1, return_index=True)[1])[:N_PAIRS]]
    ends = pairs[:, first]
    senders, receivers = np.concatenate([ends, ends[::-1]], axis=1)
    order = np.lexsort((senders, receivers))
    senders, receivers = senders[order], receivers[order]
    apart = (pos[senders] - pos[receivers]) / distance.ravel()[first].max()
    nodes = np.concatenate([value / np.sqrt(np.mean(value**2)) for value in motion], axis=1)
    edges = np.concatenate([apart, np.linalg.norm(apart, axis=1, keepdims=True)], axis=1)
    features = {"nodes": nodes.astype(np.float32), "edges": edges.astype(np.float32)}
    return {**features, "senders": senders, "receivers": receivers}, source


class System:
    """A system in a process of its own. `absent` says why it is not there."""

    def __init__(self, name: str, source: Path, package: str, peers: Path, folder: Path) -> None:
        python = sys.executable if package == HERE else str(peers / "bin" / "python")
        self.absent = ""
        for path in (Path(python), source / package):
            if not path.exists():
                self.absent = f"no {path}"
                return
        command = [python, str(Path(__file__).with_name("peer.py")), name, str(source.resolve()), str(folder)]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen(command, text=True, bufsize=1, **pipes)
        hello = self._answer()
        if "absent" in hello:
            self.absent = hello["absent"]
            return
        self.first_s = hello["first_s"]
        git = ["git", "-C", str(source)]
        quiet: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], **quiet).stdout.strip()
        changed = commit and subprocess.run([*git, "diff", "--quiet", "HEAD", "--", package], **quiet).returncode
        self.version = f"{commit or 'unknown commit'}{' with changes' if changed else ''}, {hello['version']}"

    def __call__(self, kind: str) -> list[float]:
        """Wall-clock and processor seconds of one forward pass, or of one forward and backward pass."""
        self.process.stdin.write(f"{kind}\n")  # type: ignore[union-attr]
        return self._answer()

    def _answer(self) -> Any:
        line = self.process.stdout.readline()  # type: ignore[union-attr]
        return json.loads(line or '{"absent": "its process ended, for the reason above"}')


def timed(systems: dict[str, System], rounds: int) -> dict[str, dict[str, np.ndarray]]:
    """Kind -> system -> (rounds, 2) seconds; the systems take turns, in one order and then in the other."""
    seconds: dict[str, dict[str, list]] = {kind: {name: [] for name in systems} for kind in KINDS}
    for number in range(-2, rounds):  # two rounds warm up
        for kind in KINDS:
            for name in list(systems)[:: -1 if number % 2 else 1]:
                seconds[kind][name].append(systems[name](kind))
    return {kind: {name: np.array(all_[2:]) for name, all_ in of.items()} for kind, of in seconds.items()}


def checked(graph: dict[str, np.ndarray], path: Path) -> dict[str, Any]:
    """Whether our network with a peer's weights gives its outputs and its weights' gradients, on the graph and on the
    graph with its edges shuffled; and how far off it is, as a share of their norm."""
    peer = np.load(path)
    network = ContactNetwork(
        n_sender=None,
        n_receiver=graph["nodes"].shape[1],
        n_edge=graph["edges"].shape[1],
        n_out=3,
        hidden=HIDDEN,
        layers=ROUNDS_OF_MESSAGES,
        mlp_layers=LINEAR_LAYERS,
        skip=True,
    )
    parameters = dict(paired(network, peer, "weight"))
    with torch.no_grad():
        for parameter, array in parameters.items():
            parameter.copy_(array)
    index = torch.from_numpy(np.stack([graph["senders"], graph["receivers"]]))
    nodes, edges, expected = (torch.from_numpy(array) for array in (graph["nodes"], graph["edges"], peer["output"]))
    reached = index[1].unique()
    errors = []
    for order in (torch.arange(len(edges)), torch.randperm(len(edges), generator=torch.Generator().manual_seed(0))):
        with torch.inference_mode():
            errors.append(
                error([network.eval()(None, nodes, edges[order], index[:, order])[reached]], [expected[reached]])
            )
        network.train().zero_grad()
        network(None, nodes, edges[order], index[:, order]).square().mean().backward()
        pairs = paired(network, peer, "gradient")
        errors.append(error([parameter.grad for parameter, _ in pairs], [array for _, array in pairs]))
    off = {"output_error": max(errors[::2]), "gradient_error": max(errors[1::2])}
    return {"checked": max(errors) < TOLERANCE, **{key: float(f"{value:.1e}") for key, value in off.items()}}


def paired(network: ContactNetwork, peer: Any, prefix: str) -> list[tuple[Any, torch.Tensor]]:
    """Our parameters and a peer's arrays for them; its first layer of messages is in three parts here."""

    def arrays(role: str) -> list[torch.Tensor]:
        names = [name for name in peer.files if name.startswith(f"{prefix}/{role}/")]
        return [torch.from_numpy(peer[f"{prefix}/{role}/{number}"]) for number in range(len(names))]

    found: list[Any] = [*zip(network.encode_receiver.parameters(), arrays("encode_receiver"), strict=True)]
    found += zip(network.encode_edge.parameters(), arrays("encode_edge"), strict=True)
    layer: Any
    for k, layer in enumerate(network.interactions):
        first, bias, *rest = arrays(f"message.{k}")
        parts = [layer.from_receiver.weight, layer.from_sender.weight, layer.from_edge.weight]
        found += [*zip(parts, first.split(HIDDEN, dim=1), strict=True), (layer.from_receiver.bias, bias)]
        found += zip(layer.message_mlp.parameters(), rest, strict=True)
        found += zip(layer.update_mlp.parameters(), arrays(f"update.{k}"), strict=True)
    return [*found, *zip(network.decode.parameters(), arrays("decode"), strict=True)]


def error(found: list[torch.Tensor], expected: list[torch.Tensor]) -> float:
    """The distance of all of them as a share of the expected ones' norm."""
    a, b = (torch.cat([part.double().flatten() for part in parts]) for parts in (found, expected))
    return float((a - b).norm() / b.norm())


def summary(systems: dict[str, System], checks: dict[str, Any], seconds: dict[str, Any]) -> dict[str, Any]:
    """Rows, and ours over the best peer (in bfloat16: over the best in either precision): by the clock, and by the
    processor, which other programs disturb less."""
    ms = {kind: {name: 1e3 * np.median(s, axis=0) for name, s in of.items()} for kind, of in seconds.items()}
    found: dict[str, Any] = {"rows": []}
    for name, system in systems.items():
        row: dict[str, Any] = {"system": name, "version": system.version}
        for kind in KINDS:
            wall, busy = ms[kind][name].round(1).tolist()
            row |= {f"{kind}_ms": wall, f"{kind}_processor_ms": busy}
        row["compile_s"] = round(max(0.0, system.first_s - sum(ms[kind][name][0] for kind in KINDS) / 1e3), 1)
        found["rows"].append(row | checks.get(name, {}))
    for bits, rounded in (("", False), ("_bfloat16", True)):
        ours = OURS + ROUNDED * rounded
        peers = [n for n in systems if SYSTEMS[n] != HERE and (rounded or not n.endswith(ROUNDED))]
        for kind, goal in zip(KINDS, ("forward", "training"), strict=True) if peers and ours in systems else ():
            for column, suffix in enumerate((bits, f"{bits}_processor")):
                best = min(peers, key=lambda name: ms[kind][name][column])
                ratio = np.median(seconds[kind][ours][:, column] / seconds[kind][best][:, column])
                found[f"{goal}_ratio_to_best_peer{suffix}"] = round(float(ratio), 3)
                found[f"{goal}_best_peer{suffix}"] = best
    return found


def table(results: dict[str, Any]) -> str:
    """The results as Markdown."""
    lines = ["| system | version | forward, ms | forward + backward, ms | compile, s | outputs apart |"]
    lines += ["|---|---|---|---|---|---|"]
    for row in results["rows"]:
        same = f"{row['output_error']:.1e}{'' if row['checked'] else ': ANOTHER FUNCTION'}" if "checked" in row else ""
        figures = [f"{row[f'{kind}_ms']:.0f} ({row[f'{kind}_processor_ms']:.0f})" for kind in KINDS]
        lines.append(f"| {' | '.join([row['system'], row['version'], *figures, str(row['compile_s']), same])} |")
    lines += ["", "By the clock; in brackets processor time, without what other programs took meanwhile."]
    for key, value in results.items():
        if "_ratio_" in key:
            lines.append(f"{key}: {value}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
