"""Damages files of every kind that gsgan reads, and counts how the readers answer.

    python scripts/fuzz.py [--count 10000] [--only bvh,ckpt] [--page docs/results/fuzz.md]

Each read runs in a child process with a limit on memory and processor time, and an audit hook
that ends it when it starts a program, opens a connection, or writes outside its folder. A good
outcome is a read, or one sentence (GsganError). Hostile files, which run code where they are
unpickled or instantiated carelessly, are among the files that are damaged.
"""

from __future__ import annotations

import argparse
import functools
import io
import json
import os
import pickle
import platform
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
for folder in ("", "data", "prepare", "motion", "synthetic"):
    sys.path.insert(0, str(ROOT / "tests" / folder))

import numpy as np  # noqa: E402
import torch  # noqa: E402

MEMORY = 2 << 30  # bytes that a read may take
SECONDS = 10  # of the processor
BATCH = 50  # files a child process
OUTCOMES = ("read", "refused", "traceback", "memory", "hang", "killed", "code")
GOOD = ("read", "refused")
CODE = 77  # exit status of a child that did what no reader may do
FORBIDDEN = re.compile(
    r"os\.(system|exec|posix_spawn|fork|remove|rename|rmdir|mkdir|symlink)|subprocess\.Popen"
    r"|socket\.connect|shutil\.rmtree|ctypes\.dlopen"
)

Reader = Callable[[Path], object]


class Hostile:
    """Runs a program where it is unpickled."""

    def __reduce__(self) -> Any:
        return os.system, ("touch hostile",)


# -- files and their readers


def seeds(home: Path, run: Path) -> dict[str, list[tuple[Path, Reader]]]:
    """Whole and hostile files by kind, each in a folder with what its reader needs beside it."""
    from animated_glb import write_gltf
    from capture_scenes import ring, write_qualisys, write_toml
    from conventions import write_bvh
    from make import skeletons, write_face, write_hands, write_tiny_capture
    from mannequin import choreography, mannequin
    from test_motion_readers import write_amc, write_pose
    from test_prepare_damage import opencv_yaml
    from test_prepare_reconstructions import write_colmap, write_nerfstudio
    from tiny_glb import TinyGlb
    from writers.smpl import write_smpl

    from gsgan.body.smpl import read_smpl
    from gsgan.data.calibration import read_calibration
    from gsgan.data.formats.capture import read_capture
    from gsgan.export.weights import load_weights, safetensors_file
    from gsgan.motion.readers import Source, read_motion
    from gsgan.run.runs import Run, load
    from gsgan.run.stored import CHECKPOINT, read_checkpoint
    from gsgan.skeleton import MEDIAPIPE33
    from gsgan.skeleton.proportions import measure_proportions
    from gsgan.synthetic.gltf import read_character

    p = skeletons(8)
    source = Source(
        measure_proportions(
            torch.from_numpy(p), torch.ones(p.shape[:2]).bool(), "z"
        )
    )
    found: dict[str, list[tuple[Path, Reader]]] = {}

    def folder(name: str) -> Path:
        (home / name).mkdir()
        return home / name

    def add(kind: str, path: Path, reader: Reader) -> None:
        found.setdefault(kind, []).append((path, reader))

    def move(path: Path) -> object:
        return read_motion(path, source)

    capture = write_tiny_capture(
        folder("capture"), body_pose=True, meta={"body": "free"}
    )
    write_hands(capture, 4)
    write_face(capture, 4)
    names = ("landmarks3d", "hands3d", "face3d", "body_pose")
    for name in (*(f"{n}.npz" for n in names), "cameras.json", "meta.json"):
        kind = "npz" if name.endswith("npz") else "calibration"
        add(kind, capture / name, lambda path: read_capture(path.parent))
    np.savez(home / "motion.npz", p=p, fps=25)
    add("npz", home / "motion.npz", move)
    np.savez(home / "objects.npz", p=np.array([Hostile()], dtype=object))
    add("npz", home / "objects.npz", move)
    for kind, name in (("smplx", "body.npz"), ("smpl", "smpl.pkl")):
        write_smpl(home / name, kind=kind, vertices=300)
        add(name[-3:], home / name, read_smpl)
    for name in ("body.pkl", "motion.pkl"):
        (home / name).write_bytes(pickle.dumps({"poses": Hostile()}, 2))
        add("pkl", home / name, read_smpl if name == "body.pkl" else move)
    person = mannequin()
    move_file = write_bvh(
        home / "a.bvh", person, choreography(person).at(np.ones(4)), 1 / 30
    )
    add("bvh", move_file, move)
    moves = choreography(person).at(np.arange(4) / 30)
    for suffix in ("glb", "gltf", "vrma"):
        add(
            "glb",
            write_gltf(home / f"moves.{suffix}", person, moves, 1 / 30),
            move,
        )
    amc = write_amc(folder("amc"))
    add("amc", amc, move)
    add(
        "asf",
        amc.with_name("07.asf"),
        lambda path: move(path.with_name("07_01.amc")),
    )
    points = ([name.upper() for name in MEDIAPIPE33.names], p[..., [0, 2, 1]])
    add(
        "pose",
        write_pose(home / "a.pose", {"POSE_WORLD_LANDMARKS": points}),
        move,
    )
    add("glb", TinyGlb().write(home / "a.glb"), read_character)
    for name in ("intri.yml", "extri.yml"):
        add(
            "calibration", opencv_yaml(folder(name[:5]), name), read_calibration
        )
    add(
        "calibration", write_toml(home / "Calib.toml", ring()), read_calibration
    )
    add(
        "calibration",
        write_qualisys(home / "a.qca.txt", ring()),
        read_calibration,
    )
    for name in ("cameras.bin", "images.bin"):
        place = folder(f"colmap_{name[:-4]}")
        write_colmap(place, ring(), "OPENCV", binary=True)
        add("calibration", place / name, read_calibration)
    scene = write_nerfstudio(home / "transforms.json", ring(), own=True)
    add("calibration", scene, read_calibration)
    (home / "hostile.yml").write_text(
        "%YAML:1.0\n---\na: !!python/object/apply:os.system [touch x]\n"
    )
    add("calibration", home / "hostile.yml", read_calibration)
    own = Path(shutil.copytree(run, home / "run"))
    checkpoint = own / CHECKPOINT
    weights = home / "a.safetensors"
    weights.write_bytes(safetensors_file(Run.load(own, device="cpu")))
    add("ckpt", checkpoint, lambda path: load(path.parents[1]))
    torch.save({"gsgan": Hostile()}, home / "hostile.ckpt")
    add("ckpt", home / "hostile.ckpt", read_checkpoint)
    add(
        "yaml",
        own / ".hydra" / "config.yaml",
        lambda path: load(path.parents[1]),
    )
    add("safetensors", weights, load_weights)
    hostile = home / "hostile.safetensors"
    target = json.dumps("gsgan.model.deformation.Deformation")
    content = weights.read_bytes()
    assert target[1:-1].encode() in content
    swap = b"os.system".ljust(len(target) - 2)
    hostile.write_bytes(content.replace(target[1:-1].encode(), swap))
    add("safetensors", hostile, load_weights)
    return found


# -- damage


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut, overwritten, with a part removed or repeated, or with another number in a text."""
    kind, size = rng.integers(6), max(len(data), 1)
    a, b = sorted(int(x) for x in rng.integers(size, size=2))
    if kind == 0:
        return data[:a]
    if kind == 1:
        return data[:a] + data[b:]
    if kind == 2:
        return data[:b] + data[a:b] * int(rng.integers(1, 4)) + data[b:]
    if kind == 3:
        numbers = list(re.finditer(rb"-?[0-9]+(\.[0-9]+)?", data[: 1 << 16]))
        if numbers:
            spot = numbers[rng.integers(len(numbers))]
            values = (
                b"-1",
                b"0",
                b"1e308",
                b"nan",
                b"99999999999",
                b"2147483648",
                b"",
            )
            return (
                data[: spot.start()]
                + values[rng.integers(len(values))]
                + data[spot.end() :]
            )
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        at = rng.integers(min(size, 512) if rng.random() < 0.5 else size)
        changed[at] = rng.integers(256)
    return bytes(changed)


def mutant(path: Path, rng: np.random.Generator) -> bytes:
    """A damaged copy; half of the archives have a damaged member and sums that fit it, and half of
    the safetensors a damaged header and a length that fits it."""
    data = path.read_bytes()
    if zipfile.is_zipfile(path) and rng.random() < 0.5:
        out = io.BytesIO()
        with zipfile.ZipFile(path) as source, zipfile.ZipFile(out, "w") as copy:
            chosen = source.namelist()[rng.integers(len(source.namelist()))]
            for name in source.namelist():
                held = source.read(name)
                copy.writestr(
                    name, damaged(held, rng) if name == chosen else held
                )
        return out.getvalue()
    if path.suffix == ".safetensors" and rng.random() < 0.5:
        size = struct.unpack("<Q", data[:8])[0]
        head = damaged(data[8 : 8 + size], rng)
        return struct.pack("<Q", len(head)) + head + data[8 + size :]
    return damaged(data, rng)


# -- one child process


def forbid(home: Path) -> None:
    """Ends this process when it does what no reader may do, from now on."""
    allowed, sys.dont_write_bytecode = (str(home), "/dev/", "/proc/"), True

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        writes = (
            event == "open"
            and isinstance(arguments[1], str)
            and set(arguments[1]) & set("wax+")
        )
        # a file that is open already
        inside = not writes or isinstance(arguments[0], int)
        if FORBIDDEN.match(event) or not (
            inside or str(arguments[0]).startswith(allowed)
        ):
            os.write(2, f"\n{event} {str(arguments)[:200]}\n".encode())
            os._exit(CODE)

    sys.addaudithook(hook)


def limit() -> None:
    used = (
        int(
            re.search(
                r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text()
            )[1]
        )
        << 10
    )
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def answer(path: Path, reader: Reader) -> str:
    """How a reader answers, for what does not end the process."""
    from gsgan.utils.errors import GsganError

    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # ends the process
    try:
        reader(path)
    except GsganError as error:
        return (
            "refused"
            if "\n" not in str(error).strip()
            else "traceback several lines"
        )
    except MemoryError:
        return "memory"
    except Exception as error:
        from gsgan.utils.config import one_sentence

        if one_sentence(error) is not None:  # as a command prints it
            return "refused"
        at = error.__traceback__
        while at.tb_next is not None:
            at = at.tb_next
        where = f"{Path(at.tb_frame.f_code.co_filename).name}:{at.tb_lineno}"
        return f"traceback {type(error).__name__} {where} {str(error)[:80]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return "read"


def batch(
    home: Path,
    files: list[tuple[Path, Reader]],
    kind: str,
    start: int,
    end: int,
) -> Iterator[str]:
    """The outcomes of some damaged files: from a child process, another one where it dies."""
    whole = {path: path.read_bytes() for path, _ in files}
    while start < end:
        ours, theirs = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(ours)
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            limit()
            forbid(home)
            for number in range(start, end):
                rng = np.random.default_rng([*kind.encode(), number])
                path, reader = files[number % len(files)]
                path.write_bytes(mutant(path, rng))
                result = answer(path, reader)
                path.write_bytes(whole[path])
                os.write(theirs, result.replace("\n", " ").encode() + b"\n")
            os._exit(0)
        os.close(theirs)
        with os.fdopen(ours) as stream:
            for line in stream:
                start += 1
                yield line.strip()
        status = os.waitpid(child, 0)[1]
        for path, data in whole.items():
            path.write_bytes(data)
        if start < end:
            start += 1
            stopped = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
            coded = os.WIFEXITED(status) and os.WEXITSTATUS(status) == CODE
            yield (
                "code"
                if coded
                else "hang"
                if stopped == signal.SIGPROF
                else f"killed {stopped}"
            )


def fuzz(
    run: Path, count: int, only: set[str] | None = None
) -> tuple[dict[str, Counter[str]], list[str]]:
    """Outcomes by kind of file, and what was wrong, with the number that makes it again.

    Args:
        run: the folder of a trained tiny run.
        count: files, over all kinds.
        only: kinds; None for all.
    """
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as place:
        home = Path(place).resolve()
        known = seeds(home, run)
        os.chdir(home)
        table, wrong = {}, []
        chosen = [kind for kind in known if only is None or kind in only]
        for i, kind in enumerate(chosen):
            # imports, caches; hostile ones are refused
            for path, reader in known[kind]:
                if "hostile" not in path.name and "objects" not in path.name:
                    first = answer(path, reader)
                    assert path.suffix == ".pkl" or first == "read", (
                        f"{path}: {first}"
                    )
            share = count // len(chosen) + (i < count % len(chosen))
            table[kind] = Counter()
            for start in range(0, share, BATCH):
                end = min(start + BATCH, share)
                for number, outcome in enumerate(
                    batch(home, known[kind], kind, start, end), start
                ):
                    table[kind][outcome.split()[0]] += 1
                    if outcome not in GOOD:
                        file = known[kind][number % len(known[kind])][0].name
                        wrong.append(f"{kind} {number} {file}: {outcome}")
            print(kind, dict(table[kind]), flush=True)
        os.chdir(ROOT)
        return table, wrong


def page(table: dict[str, Counter[str]], seconds: float) -> str:
    command = ["git", "describe", "--always", "--dirty"]
    commit = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    total = sum(table.values(), Counter())
    shown = [name for name in OUTCOMES if name in GOOD or total[name]]
    lines = [
        "# Damaged files",
        "",
        f"`python scripts/fuzz.py`, commit {commit}, machine {platform.machine()} (cpu), "
        f"{time.strftime('%Y-%m-%d')}, {seconds / 60:.0f} minutes.",
        "",
        f"Reads of damaged and hostile files, each with {MEMORY >> 30} GB of memory and {SECONDS} "
        "seconds of processor time.\nPossible outcomes are: read, refused with one sentence, "
        "ended with a traceback, out of memory\nor time, killed, and code that no reader may run. "
        "Those that occurred:",
        "",
        "| kind | files | " + " | ".join(shown) + " |",
        "|---" * (len(shown) + 2) + "|",
    ]
    for kind, found in {**table, "all": total}.items():
        counts = " | ".join(str(found[name]) for name in shown)
        lines.append(f"| {kind} | {sum(found.values())} | {counts} |")
    return "\n".join(lines) + "\n"


@functools.cache
def tiny_run() -> Path:
    """A run folder, trained in seconds."""
    from make import write_tiny_capture

    place = Path(tempfile.mkdtemp())
    write_tiny_capture(place / "capture", cameras=3, frames=6, size=(48, 48), labels=True,
                       body_pose=True, meta={"body": "free"})  # fmt: skip
    given = [
        "size=tiny",
        "training=smoke",
        "data=capture",
        "data.size=32",
        "data.crop=null",
    ]
    given += [
        f"data.root={place / 'capture'}",
        f"hydra.run.dir={place / 'run'}",
        "evaluate=false",
    ]
    subprocess.run(
        [sys.executable, "-m", "gsgan.train", *given],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return place / "run"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--only", type=lambda text: set(text.split(",")))
    parser.add_argument("--run", type=Path, help="a trained tiny run")
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    began = time.monotonic()
    table, wrong = fuzz(
        (given.run or tiny_run()).resolve(), given.count, given.only
    )
    text = page(table, time.monotonic() - began)
    print(text, *wrong, sep="\n")
    if given.page:
        given.page.write_text(text)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
