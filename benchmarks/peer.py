"""One system for `benchmarks.peers`, in an interpreter that has it: `python peer.py SYSTEM SOURCE FOLDER`.

Reads FOLDER/graph.npz and writes FOLDER/SYSTEM.npz: weights, output and weight gradients on that graph, with the
weights laid out as `ContactNetwork` reads them. Says who it is, and how long the first calls took; then answers every
line on stdin, "forward" or "forward_backward", with its wall-clock and processor seconds. Lines on stdout are JSON.
"NAME, bfloat16" is the system NAME under autocast. Imports nothing of the project unless NAME is `gns_pyg`.
"""

import json
import os
import sys
import time
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

HIDDEN, ROUNDS_OF_MESSAGES, LINEAR_LAYERS = 128, 3, 3
ROLES = ["encode_receiver", "encode_edge"]
ROLES += [f"{role}.{k}" for k in range(ROUNDS_OF_MESSAGES) for role in ("message", "update")] + ["decode"]
# Blocks of HIDDEN inputs of a first layer, where a system orders them otherwise than [receiver, sender, edge] and
# [receiver, messages].
Order = dict[str, list[int]]


def main(system: str, source: str, folder: str) -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print goes to stderr, out of the way of the answers
    sys.path.insert(0, source)
    graph = dict(np.load(Path(folder) / "graph.npz"))
    try:
        running = SYSTEMS[system](graph)
    except ImportError as error:
        print(json.dumps({"absent": str(error)}), file=answers)
        return
    begin = time.perf_counter()
    output = running.forward(*running.inputs(graph))
    running.forward_backward(*running.inputs(graph))
    first_s = time.perf_counter() - begin
    found: dict[str, Any] = {"output": output, **running.weights("weight"), **running.weights("gradient")}
    np.savez(Path(folder) / f"{system}.npz", **found)
    print(json.dumps({"version": running.version, "first_s": first_s}), file=answers)
    random = np.random.default_rng(0)
    for line in sys.stdin:
        noise = {key: 1e-3 * random.standard_normal(graph[key].shape, np.float32) for key in ("nodes", "edges")}
        inputs = running.inputs({**graph, **{key: graph[key] + value for key, value in noise.items()}})
        running.step()  # other inputs, other weights: nothing can be kept from the round before
        timed = getattr(running, line.strip())
        begin, busy = time.perf_counter(), time.process_time()
        timed(*inputs)
        print(json.dumps([time.perf_counter() - begin, time.process_time() - busy]), file=answers)


def laid_out(parts: list[list[np.ndarray]], order: Order, prefix: str) -> dict[str, np.ndarray]:
    """Arrays by role and number, the MLPs given in the order of `ROLES`, their first layers' columns mended."""
    found: dict[str, np.ndarray] = {}
    for role, (first, *rest) in zip(ROLES, parts, strict=True):
        if (wanted := order.get(role.partition(".")[0])) is not None:
            first = np.concatenate([first[:, HIDDEN * k : HIDDEN * (k + 1)] for k in wanted], axis=1)
        found |= {f"{prefix}/{role}/{number}": array for number, array in enumerate([first, *rest])}
    return found


class Torch:
    """A system in PyTorch.

    Args:
        network: called with (nodes, edges, edge_index).
        parts: its MLPs in the order of `ROLES`.
        bfloat16: multiplies in bfloat16, under autocast (as `execution.precision` does).
    """

    def __init__(self, network: Any, parts: list[Any], order: Order, *, bfloat16: bool) -> None:
        import torch

        torch.set_num_threads(1)
        self.torch, self.network, self.parts, self.order, self.bfloat16 = torch, network, parts, order, bfloat16
        self.version = f"PyTorch {torch.__version__}"

    def inputs(self, graph: dict[str, np.ndarray]) -> list[Any]:
        index = np.stack([graph["senders"], graph["receivers"]])
        return [self.torch.tensor(array) for array in (graph["nodes"], graph["edges"], index)]

    def forward(self, *inputs: Any) -> np.ndarray:
        self.network.eval()
        with self.torch.inference_mode():
            return self.output(*inputs).numpy()

    def forward_backward(self, *inputs: Any) -> None:
        self.network.train()
        self.output(*inputs).square().mean().backward()

    def output(self, *inputs: Any) -> Any:
        with self.torch.autocast("cpu", self.torch.bfloat16, enabled=self.bfloat16):
            return self.network(*inputs).float()

    def step(self) -> None:
        with self.torch.no_grad():
            for parameter in self.network.parameters():
                if parameter.grad is not None:
                    parameter -= 1e-6 * parameter.grad
                    parameter.grad = None

    def weights(self, prefix: str) -> dict[str, np.ndarray]:
        def array(parameter: Any) -> np.ndarray:
            return (parameter.detach() if prefix == "weight" else parameter.grad).numpy().copy()

        parts = [[array(parameter) for parameter in part.parameters()] for part in self.parts]
        return laid_out(parts, self.order, prefix) if parts else {}


def gns_pyg(graph: dict[str, np.ndarray], *, bfloat16: bool = False) -> Torch:
    import torch

    from gns_pyg.models.contact_network import ContactNetwork

    torch.manual_seed(0)  # the same weights in either precision

    class Ours(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            n_receiver, n_edge = graph["nodes"].shape[1], graph["edges"].shape[1]
            sizes: dict[str, Any] = {"hidden": HIDDEN, "layers": ROUNDS_OF_MESSAGES, "mlp_layers": LINEAR_LAYERS}
            self.network = ContactNetwork(
                n_sender=None, n_receiver=n_receiver, n_edge=n_edge, n_out=3, skip=True, **sizes
            )

        def forward(self, nodes: Any, edges: Any, edge_index: Any) -> Any:
            return self.network(None, nodes, edges, edge_index)

    return Torch(Ours(), [], {}, bfloat16=bfloat16)


def geoelements(graph: dict[str, np.ndarray], *, bfloat16: bool = False) -> Torch:
    import torch
    from gns.graph_network import EncodeProcessDecode

    torch.manual_seed(0)

    class Gns(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            n_node, n_edge = graph["nodes"].shape[1], graph["edges"].shape[1]
            self.network = EncodeProcessDecode(n_node, 3, n_edge, HIDDEN, ROUNDS_OF_MESSAGES, LINEAR_LAYERS - 1, HIDDEN)

        def forward(self, nodes: Any, edges: Any, edge_index: Any) -> Any:
            return self.network(nodes, edge_index, edges)

    gns = Gns()
    encoder, processor, decoder = gns.network._encoder, gns.network._processor, gns.network._decoder
    rounds = [part for layer in processor.gnn_stacks for part in (layer.edge_fn, layer.node_fn)]
    parts = [encoder.node_fn, encoder.edge_fn, *rounds, decoder.node_fn]
    return Torch(gns, parts, {"update": [1, 0]}, bfloat16=bfloat16)


class LagrangeBench:
    """GNS of LagrangeBench, compiled by XLA as its own trainer does. Of its package only the model is imported."""

    def __init__(self, graph: dict[str, np.ndarray]) -> None:
        import haiku as hk
        import jax

        for name in ("lagrangebench", "lagrangebench.models"):  # their __init__ need data tools that are not used
            sys.modules[name] = package = ModuleType(name)
            package.__path__ = [f"{sys.path[0]}/{name.replace('.', '/')}"]
        from lagrangebench.models.gns import GNS

        gns = hk.without_apply_rng(
            hk.transform(lambda sample: GNS(3, HIDDEN, LINEAR_LAYERS, ROUNDS_OF_MESSAGES, 16, 1)(sample)["acc"])
        )
        self.jax, self.version = jax, f"JAX {jax.__version__}"
        self.parameters = gns.init(jax.random.PRNGKey(0), self.inputs(graph)[0])
        self.gradients: Any = None
        self.apply = jax.jit(gns.apply)
        self.loss = jax.jit(jax.value_and_grad(lambda weights, sample: (gns.apply(weights, sample) ** 2).mean()))

    def inputs(self, graph: dict[str, np.ndarray]) -> list[Any]:
        features = {"vel_hist": graph["nodes"], "rel_disp": graph["edges"][:, :3], "rel_dist": graph["edges"][:, 3:]}
        index = {key: graph[key].astype(np.int32) for key in ("senders", "receivers")}
        particle_type = np.zeros(len(graph["nodes"]), np.int32)
        return [self.jax.block_until_ready(self.jax.device_put(({**features, **index}, particle_type)))]

    def forward(self, sample: Any) -> np.ndarray:
        return np.asarray(self.apply(self.parameters, sample))

    def forward_backward(self, sample: Any) -> None:
        self.gradients = self.jax.block_until_ready(self.loss(self.parameters, sample)[1])

    def step(self) -> None:
        if self.gradients is not None:
            moved = self.jax.tree_util.tree_map(lambda w, g: w - 1e-6 * g, self.parameters, self.gradients)
            self.parameters, self.gradients = self.jax.block_until_ready(moved), None

    def weights(self, prefix: str) -> dict[str, np.ndarray]:
        named = self.parameters if prefix == "weight" else self.gradients
        parts = []
        scopes = [("encoder", k) for k in range(2)] + [("processor", k) for k in range(2 * ROUNDS_OF_MESSAGES)]
        for scope, number in [*scopes, ("decoder", 0)]:
            end = f"_{number}" if number else ""
            layers = [named[f"gns/~_{scope}/MLP{end}/~/linear_{k}"] for k in range(LINEAR_LAYERS)]
            arrays = [array for layer in layers for array in (np.asarray(layer["w"]).T, layer["b"])]
            if (norm := named.get(f"gns/~_{scope}/layer_norm{end}")) is not None:
                arrays += [norm["scale"], norm["offset"]]
            parts.append([np.asarray(array) for array in arrays])
        return laid_out(parts, {"message": [1, 0, 2]}, prefix)


SYSTEMS: dict[str, Any] = {
    "gns_pyg": gns_pyg,
    "gns_pyg, bfloat16": partial(gns_pyg, bfloat16=True),
    "geoelements": geoelements,
    "geoelements, bfloat16": partial(geoelements, bfloat16=True),
    "LagrangeBench": LagrangeBench,
}

if __name__ == "__main__":
    main(*sys.argv[1:])
