"""Damaged and hostile files: every one a function of the sample and a seed. `check` opens them in a worker process
whose memory and time are limited, where nothing may be executed, and says which gave anything but a sound object or
one of our own errors."""

import io
import json
import os
import pickle
import resource
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import yaml
from safetensors.torch import load_file, save_file

from gns_pyg.errors import GnsError
from tests.faults.samples import OPEN

MORE_MEMORY = 2**30  # bytes of address space beyond what the interpreter has when the first file is opened
MOST_SECONDS = 30  # of processor time, so that a busy machine changes nothing
MOST_WAITED_SECONDS = 600  # for one that hangs without computing
EXECUTES = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect", "os.remove")
ODD: list[Any] = [
    *(0, -1, 1, 2, 10**12, 10**30, 1e300, -1e300, 1e-300, float("nan"), float("inf"), True, None),
    *("", "text", "1e9999", "nan", "${oc.env:HOME}", "${nothing}", "???", "../../etc/passwd", "\x00", "é" * 50),
    *([], [1, 2], [[[]]], {}, {"_target_": "os.system", "command": "touch executed"}, ["a"] * 1000, 10**400),
    "__import__('os').system('touch executed')",
]


class Refuse(Exception):
    """A file that had to be refused was not."""


class Hostile:
    """Pickles as a call of os.system."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch executed",)


def flip_bits(path: Path, random: np.random.Generator) -> None:
    data = bytearray(path.read_bytes())
    for place in random.integers(0, len(data), random.integers(1, 20)):
        data[place] ^= 1 << int(random.integers(8))
    path.write_bytes(data)


def flip_head(path: Path, random: np.random.Generator) -> None:
    """Bit flips where formats keep their structure."""
    data = bytearray(path.read_bytes())
    for place in random.integers(0, min(len(data), 1024), random.integers(1, 4)):
        data[place] = int(random.integers(256))
    path.write_bytes(data)


def truncate(path: Path, random: np.random.Generator) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(random.integers(len(data)))])


def splice(path: Path, random: np.random.Generator) -> None:
    """One stretch of bytes over another."""
    data = bytearray(path.read_bytes())
    source, target = random.integers(0, len(data), 2)
    length = int(random.integers(1, 1 + len(data) // 4))
    piece = data[source : source + length]
    data[target : target + len(piece)] = piece
    path.write_bytes(data)


def garbage(path: Path, random: np.random.Generator) -> None:
    path.write_bytes(random.bytes(int(random.integers(0, 5000))))


BYTES = [flip_bits, flip_head, truncate, splice, garbage]


def places(values: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The way to every entry of nested dicts and lists."""
    entries = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in entries:
        yield (*at, key)
        yield from places(value, (*at, key))


def change(values: Any, random: np.random.Generator) -> None:
    """Replaces, removes, doubles or swaps one to three entries of nested dicts and lists."""
    for _ in range(random.integers(1, 4)):
        ways = list(places(values))
        if not ways:
            return
        way, other = (ways[int(random.integers(len(ways)))] for _ in range(2))
        owner = follow(values, way[:-1])
        action = random.integers(5)
        if action == 0:
            del owner[way[-1]]
        elif action == 1 and isinstance(owner, dict):
            owner[f"{way[-1]}x"] = deepcopy(owner[way[-1]])
        elif action == 2 and other[: len(way)] != way and way[: len(other)] != other:
            second = follow(values, other[:-1])
            owner[way[-1]], second[other[-1]] = second[other[-1]], owner[way[-1]]
        else:
            owner[way[-1]] = deepcopy(ODD[int(random.integers(len(ODD)))])


def follow(values: Any, way: tuple[Any, ...]) -> Any:
    for key in way:
        values = values[key]
    return values


def change_trajectory(path: Path, random: np.random.Generator) -> None:
    """Data sets swapped, replaced by others of absurd shapes, types and values, attributes changed."""
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        sets = [name for name in names if isinstance(file[name], h5py.Dataset)]
        one, two = (sets[int(random.integers(len(sets)))] for _ in range(2))
        action = int(random.integers(7))
        if action == 0 and one != two:
            file.move(one, "aside")
            file.move(two, one)
            file.move("aside", two)
        elif action == 1:
            attributes = dict(file[one].attrs)
            shape = tuple(int(10 ** random.uniform(0, 13)) for _ in file[one].shape) or (10**12,)
            del file[one]
            chunks = tuple(min(length, 64) for length in shape)
            file.create_dataset(one, shape, random.choice(["f8", "i4", "u1"]), chunks=chunks).attrs.update(attributes)
        elif action == 2:
            values = file[one][...].astype(float)
            values.flat[random.integers(values.size)] = random.choice([np.nan, np.inf, -np.inf, 1e300, -1e300, 0, -1])
            attributes = dict(file[one].attrs)
            del file[one]
            file.create_dataset(one, data=values).attrs.update(attributes)
        elif action == 3:
            attributes, shape = dict(file[one].attrs), file[one].shape
            del file[one]
            odd: list[Any] = ["text", b"bytes", np.array([b"ab"] * 3), 1.0, np.zeros(shape, complex), np.zeros(0)]
            file.create_dataset(one, data=odd[int(random.integers(len(odd)))]).attrs.update(attributes)
        elif action == 4:
            owner = file[names[int(random.integers(len(names)))]]
            for name in list(owner.attrs):
                odd = [1.0, "text", "{}", "[" * 10**5, np.zeros(3), np.array([b"x"]), '{"_target_": "os.system"}']
                owner.attrs[name] = odd[int(random.integers(len(odd)))]
        elif action == 5:
            del file[names[int(random.integers(len(names)))]]
        else:
            key = "parameters" if random.integers(2) else "boundary/walls"
            name = "scene" if key == "parameters" else "motion"
            values = json.loads(file[key].attrs[name])
            change(values, random)
            file[key].attrs[name] = json.dumps(values)


def point_elsewhere(path: Path, random: np.random.Generator) -> None:
    """A link, external storage or a virtual data set that reads another, sound file; it must be refused."""
    other = path.parent / "other.h5"
    shutil.copyfile(path, other)
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        name = names[int(random.integers(len(names)))]
        found = file[name]
        kind = int(random.integers(3)) if isinstance(found, h5py.Dataset) and found.shape else 0
        attributes, shape, dtype = dict(found.attrs), getattr(found, "shape", ()), getattr(found, "dtype", None)
        del file[name]
        if kind == 0:
            file[name] = h5py.ExternalLink(str(other), name)
            return
        if kind == 1:
            layout = h5py.VirtualLayout(shape, dtype)
            layout[...] = h5py.VirtualSource(str(other), name, shape)
            made = file.create_virtual_dataset(name, layout)
        else:
            made = file.create_dataset(name, shape, dtype, external=[(str(other), 0, h5py.h5f.UNLIMITED)])
        made.attrs.update(attributes)


def change_yaml(path: Path, random: np.random.Generator) -> None:
    values = yaml.safe_load(path.read_text())
    change(values, random)
    path.write_text(yaml.safe_dump(values))


def tag_yaml(path: Path, random: np.random.Generator) -> None:
    """YAML's tags for Python objects; must be refused."""
    tag = ["!!python/object/apply:os.system ['touch executed']", "!!python/name:os.system"][int(random.integers(2))]
    path.write_text(path.read_text() + f"name: {tag}\n")


def change_description(path: Path, random: np.random.Generator) -> None:
    """bundle.json with other values, or cut and flipped as bytes."""
    file = path / "bundle.json"
    if random.random() < 0.2:
        BYTES[int(random.integers(len(BYTES)))](file, random)
        return
    values = json.loads(file.read_text())
    change(values, random)
    file.write_text(json.dumps(values))


def change_weights(path: Path, random: np.random.Generator) -> None:
    """weights.safetensors with bytes, names, shapes, types or values changed."""
    file = path / "weights.safetensors"
    if random.random() < 0.5:
        BYTES[int(random.integers(len(BYTES)))](file, random)
        return
    weights = load_file(file)
    names = sorted(weights)
    one, two = (names[int(random.integers(len(names)))] for _ in range(2))
    action = int(random.integers(5))
    if action == 0:
        weights[one], weights[two] = weights[two], weights[one]
    elif action == 1:
        weights.pop(one)
    elif action == 2:
        weights[one].view(-1)[int(random.integers(weights[one].numel()))] = float(random.choice([np.nan, np.inf]))
    elif action == 3:
        weights[one] = torch.zeros([int(n) for n in random.integers(0, 5, random.integers(0, 4))])
    else:
        weights[one] = weights[one].to([torch.int8, torch.float16, torch.bool][int(random.integers(3))])
    save_file({name: value.clone() for name, value in weights.items()}, file)


def link_away(path: Path, random: np.random.Generator) -> None:
    """A pickle where the weights belong; must be refused."""
    name = ["bundle.json", "weights.safetensors"][int(random.integers(2))]
    (path / name).write_bytes(pickle.dumps(Hostile()))


def change_checkpoint(path: Path, random: np.random.Generator) -> None:
    """A whole archive with valid checksums that holds other values."""
    checkpoint = torch.load(path, weights_only=True)
    if random.random() < 0.3:
        tensors = [way for way in places(checkpoint) if isinstance(follow(checkpoint, way), torch.Tensor)]
        way = tensors[int(random.integers(len(tensors)))]
        old = follow(checkpoint, way)
        odd = [
            torch.full_like(old, torch.nan) if old.is_floating_point() else old[..., None],
            old.expand(10**6, *old.shape),
        ]
        odd += [torch.zeros(3), torch.zeros(1).expand(10**13), old.double()]
        follow(checkpoint, way[:-1])[way[-1]] = odd[int(random.integers(len(odd)))]
    else:
        change(checkpoint, random)
    torch.save(checkpoint, path)


def hostile_checkpoint(path: Path, random: np.random.Generator) -> None:
    """A checkpoint that would run a command when unpickled; must be refused."""
    checkpoint = torch.load(path, weights_only=True)
    way = list(places(checkpoint))[int(random.integers(10))]
    follow(checkpoint, way[:-1])[way[-1]] = Hostile()
    content = io.BytesIO()
    torch.save(checkpoint, content) if random.integers(2) else pickle.dump(checkpoint, content)
    path.write_bytes(content.getvalue())


def change_stl(path: Path, random: np.random.Generator) -> None:
    """Other counts, corners that are not finite or far away, text, or another format's content."""
    data = bytearray(path.read_bytes())
    action = int(random.integers(4))
    if action == 0:
        data[80:84] = int(random.integers(2**32)).to_bytes(4, "little")
    elif action == 1:
        place = 84 + 50 * int(random.integers((len(data) - 84) // 50)) + 4 * int(random.integers(12))
        data[place : place + 4] = np.float32(random.choice([np.nan, np.inf, 1e38, -1e38, 0])).tobytes()
    elif action == 2:
        data = bytearray(b"solid x\n facet normal 0 0 1\n outer loop\n" + b" vertex 1 nan text\n" * 3 + b"endsolid")
    else:
        data = bytearray(pickle.dumps(Hostile()))
    path.write_bytes(data)


MUTATIONS: dict[str, list[Callable[[Path, np.random.Generator], None]]] = {
    "trajectory.h5": [*BYTES, change_trajectory, change_trajectory, change_trajectory, point_elsewhere],
    "bundle": [change_description, change_weights, change_description, change_weights, link_away],
    "checkpoint.ckpt": [*BYTES, change_checkpoint, change_checkpoint, hostile_checkpoint],
    "scene.yaml": [flip_bits, truncate, splice, change_yaml, change_yaml, change_yaml, change_yaml, tag_yaml],
    "mesh.stl": [*BYTES, change_stl, change_stl],
}
MUST_REFUSE = {point_elsewhere, link_away, tag_yaml, hostile_checkpoint, garbage}


def mutate(name: str, samples: Path, folder: Path, seed: int) -> Callable[[Path, np.random.Generator], None]:
    """Writes damaged file number `seed` of a kind to `folder`; returns the mutation."""
    source, target = samples / name, folder / name
    shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
    shutil.copytree(source, target) if source.is_dir() else shutil.copyfile(source, target)
    random = np.random.default_rng((sorted(MUTATIONS).index(name), seed))
    mutation = MUTATIONS[name][int(random.integers(len(MUTATIONS[name])))]
    mutation(target, random)
    return mutation


def open_one(name: str, samples: Path, folder: Path, seed: int) -> str:
    """`opened`, `refused` (one of our errors), or the traceback of what should not have happened."""
    mutation = mutate(name, samples, folder, seed)
    try:
        OPEN[name](folder / name, samples / "data")
        if mutation in MUST_REFUSE:
            raise Refuse(f"{mutation.__name__} was opened")
    except GnsError:
        return "refused"
    except BaseException:
        return f"{mutation.__name__}\n{traceback.format_exc()}"
    finally:
        if Path("executed").exists():
            os._exit(99)
    return "opened"


def worker(name: str, samples: Path, folder: Path, seeds: range, out: int) -> None:
    """Opens files one after the other, a line per file to `out`; it dies of what it cannot survive."""
    os.chdir(folder)
    opening = [False]

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if opening[0] and event in EXECUTES and event != "os.remove":
            os.write(out, (json.dumps(f"executed {event} {arguments!r:.200}") + "\n").encode())
            os._exit(99)

    sys.addaudithook(watch)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MORE_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    for seed in seeds:
        signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
        signal.alarm(MOST_WAITED_SECONDS)
        opening[0] = True
        told = open_one(name, samples, folder, seed)
        opening[0] = False
        os.write(out, (json.dumps(told) + "\n").encode())
    os._exit(0)


def check(name: str, samples: Path, folder: Path, seeds: range) -> tuple[dict[str, int], dict[int, str], float]:
    """Opens damaged files of a kind.

    Returns:
        How many were opened and refused; seed -> what happened, for all others; the worker's peak memory, MB.
    """
    folder.mkdir(parents=True, exist_ok=True)
    counts, wrong, peak_mb, start = {"opened": 0, "refused": 0}, {}, 0.0, seeds.start
    while start < seeds.stop:
        reader, writer = os.pipe()
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            os.close(reader)
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            worker(name, samples, folder, range(start, seeds.stop), writer)
        os.close(writer)
        with os.fdopen(reader) as lines:
            for line in lines:
                told = json.loads(line)
                if told in counts:
                    counts[told] += 1
                else:
                    wrong[start] = told
                start += 1
        _, status, usage = os.wait4(child, 0)
        peak_mb = max(peak_mb, usage.ru_maxrss / 1024)
        if start < seeds.stop:  # it died over this file
            wrong.setdefault(start, f"the process ended with status {status}")
            start += 1
    return counts, wrong, peak_mb
